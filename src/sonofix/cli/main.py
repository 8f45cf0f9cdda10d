"""The `sonofix` command: its commands, and the one place where errors become lines for the user."""

from __future__ import annotations

import errno
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from sonofix.cli.calibrate import calibrate
from sonofix.cli.check import check
from sonofix.cli.codes import codes
from sonofix.cli.console import Stopped, heed_ctrl_c
from sonofix.cli.demo import demo
from sonofix.cli.explain import explain
from sonofix.cli.export import export
from sonofix.cli.import_bag import import_bag
from sonofix.cli.plan import plan
from sonofix.cli.run import run
from sonofix.cli.score import score
from sonofix.cli.simulate import simulate
from sonofix.cli.study import study
from sonofix.cli.survey import survey

MISUSE = 2
INTERRUPTED = 130
BROKEN = 1


class Shell(TyperGroup):
    """Runs a command; what goes wrong is told in plain lines on stderr, never by a traceback.

    Exit codes: 2 for mistakes in what was given (each on a line) and for disks that are full or closed to us, 130 after
    Ctrl-C, 1 for a mistake of the program itself.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the command of this context."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as stop:
            typer.echo(str(stop) if isinstance(stop, Stopped) else "stopped", err=True)
            raise typer.Exit(INTERRUPTED) from None
        except Exception as error:
            if ctx.params.get("debug") or _belongs_to_typer(error):
                raise
            code, lines = _told(error)
            for line in lines:
                typer.echo(line, err=True)
            raise typer.Exit(code) from None


def _belongs_to_typer(error: Exception) -> bool:
    """Say whether typer itself handles an error: usage mistakes, exits, a reader that closed the pipe."""
    usage = hasattr(error, "exit_code") or isinstance(error, typer.Abort)
    return usage or (isinstance(error, OSError) and error.errno == errno.EPIPE)


def _told(error: Exception) -> tuple[int, list[str]]:
    """Return the exit code and the lines that tell an error."""
    from sonofix.files import RecordingError

    if isinstance(error, RecordingError):
        return MISUSE, [str(problem) for problem in error.problems]
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return MISUSE, [f"{where}{error.strerror or error}"]
    text = " ".join(str(error).split())
    # NumPy's LinAlgError is a ValueError too, but no user's mistake
    if type(error) is ValueError:
        return MISUSE, [text]
    kind = type(error).__name__
    return BROKEN, [f"mistake in sonofix: {kind}: {text}", "`sonofix --debug …` shows where; please report it"]


app = typer.Typer(
    cls=Shell,
    name="sonofix",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"sonofix {version('sonofix')}")
        raise typer.Exit()


@app.callback()
def sonofix(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and leave.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show where an error came from.")] = False,
) -> None:
    """Positioning by sound: from microphone samples to a fused track."""


for command in (run, check, simulate, score, explain, codes, plan, calibrate, survey, study, export, demo):
    app.command()(command)
app.command("import")(import_bag)


def main() -> None:
    """Run the command line."""
    # names of sites and signs such as ± must not break on a terminal or pipe with a narrow encoding
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # pyright: ignore[reportAttributeAccessIssue]
    heed_ctrl_c()
    app()
