"""`python -m sonofix` is the command `sonofix`."""

from sonofix.cli.main import main

main()
