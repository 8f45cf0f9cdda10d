"""Run the long statistics and put the tables they print into docs/statistics.md, if all hold.

    python benchmarks/prove.py docs/statistics.md [TESTS …]

With tests named, those alone are run and only their tables are renewed.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

MARK = "<!-- from here on as printed -->\n"


def tables(printed: Sequence[str]) -> list[str]:
    """Pick Markdown tables with the sentences right before them out of what pytest printed.

    Each becomes a block: sentences, an empty line, the table. What pytest says of its own progress is left out.
    """
    blocks: list[str] = []
    before: list[str] = []
    rows: list[str] = []
    for line in [*printed, ""]:
        text = line.strip()
        if text.startswith("|"):
            rows.append(text)
            continue
        if rows:
            blocks.append("\n".join([*before, *([""] if before else []), *rows]))
            before, rows = [], []
        if set(text) <= set(".FEsx") or text.startswith(("tests/", "=")):
            before = before if not text else []
        else:
            before.append(text)
    return blocks


def renewed(page: str, blocks: Sequence[str], whole: bool) -> str:
    """Return the page with these blocks: in place of all, or of those that begin with the same line; new ones last."""
    head, mark, rest = page.partition(MARK)
    by_line = {} if whole else {block.partition("\n")[0]: block for block in tables(rest.splitlines())}
    by_line |= {block.partition("\n")[0]: block for block in blocks}
    return head + mark + "\n" + "\n\n".join(by_line.values()) + "\n"


def main() -> None:
    """Run pytest on all tests, or on those named, show what it prints as it comes, and renew the page given."""
    page, asked = Path(sys.argv[1]), sys.argv[2:]
    command = [sys.executable, "-m", "pytest", "-q", "-s", "--no-header", "-m", "prove", *(asked or ["tests"])]
    printed: list[str] = []
    # the receiver's statistics run in processes, a core each: threads of BLAS would only wait for each other
    environment = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", **os.environ}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as running:
        assert running.stdout is not None
        for line in running.stdout:
            print(line, end="", flush=True)
            printed.append(line)
    if running.returncode:
        sys.exit(running.returncode)
    page.write_text(renewed(page.read_text("utf-8"), tables(printed), whole=not asked), "utf-8")


if __name__ == "__main__":
    main()
