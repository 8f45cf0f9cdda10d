"""Every picture, drawn from records alone.

Pictures come back as Matplotlib figures on an Agg canvas: nothing global is touched, no window opens, and saving is the
caller's business (``figure.savefig(path)``). Needs the extra ``plot``.
"""
