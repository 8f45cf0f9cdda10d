"""The `sonofix` command: its commands, and the one place where errors become lines for the user."""

from __future__ import annotations

import errno
import sys
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from sonofix.cli.console import Stopped, heed_ctrl_c

# what help says of each: a command is imported only when it is asked for, as all of them take longer than typer itself
COMMANDS = {
    "run": "Turn a recording into ranges, fixes, a track and a picture.",
    "check": "Say what a recording holds: beacons, codes, microphones, samples, coverage, and anything odd.",
    "simulate": "Make a recording folder: what the site's microphones would hear, 16 bit, and the truth beside it.",
    "score": "Score ranges and track of a run against the recording's truth.",
    "team": "Place a team of robots by odometry, landmarks and each other; draw tracks and roles.",
    "explain": "Show what the receiver saw in one epoch: spectrum, searches, paths, what was cancelled and left out.",
    "codes": "Choose codes for beacons: those whose worst pair disturbs least.",
    "plan": "Map what the beacons promise over the floor, and place more where they help most.",
    "calibrate": "Learn a beacon's real burst, its delay and its clock from a recording at rest.",
    "survey": "Find beacons, their delays and the sound speed from a drive among them; write a corrected site file.",
    "study": "Redo a paper's simulation on its own numbers, check its claims, and run the same from waveforms.",
    "import": "Bring a robot's bag into a recording: ranges, odometry, inertial sensors and, if asked for, truth.",
    "export": "Write a track as TUM, MCAP, Parquet or NMEA.",
    "demo": "Simulate a drive through a hall, run the receiver on it, draw.",
}
# where a command cannot be named as it is called
MODULES = {"import": "import_bag"}

MISUSE = 2
INTERRUPTED = 130
BROKEN = 1

PLAIN: Any = {
    "add_completion": False,
    "pretty_exceptions_enable": False,
    "rich_markup_mode": None,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}


class Shell(TyperGroup):
    """Runs a command; what goes wrong is told in plain lines on stderr, never by a traceback.

    Exit codes: 2 for mistakes in what was given (each on a line) and for disks that are full or closed to us, 130 after
    Ctrl-C, 1 for a mistake of the program itself.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        """Name the commands in the order of help."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Import a command; None where there is none of that name."""
        if cmd_name not in self.commands and cmd_name in COMMANDS:
            module = MODULES.get(cmd_name, cmd_name)
            one = typer.Typer(**PLAIN)
            one.command(cmd_name)(getattr(import_module(f"sonofix.cli.{module}"), module))
            self.commands[cmd_name] = typer.main.get_command(one)
        return super().get_command(ctx, cmd_name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List what each command does, without importing it."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))

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


app = typer.Typer(cls=Shell, name="sonofix", no_args_is_help=True, **PLAIN)


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


def main() -> None:
    """Run the command line."""
    # names of sites and signs such as ± must not break on a terminal or pipe with a narrow encoding
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # pyright: ignore[reportAttributeAccessIssue]
    heed_ctrl_c()
    app()
