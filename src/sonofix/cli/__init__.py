"""The command line: a file a command, and `main` that joins them."""

import os

# Matrices here are small and many: threads inside each product would spend their time waiting for each other.
# This must stand before numpy is first imported; who sets it otherwise is left alone.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
