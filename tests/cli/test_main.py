"""The command as a whole: help, version, speed, and errors told in lines."""

import errno
import subprocess
import sys
import time
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from sonofix.cli.console import Stopped
from sonofix.cli.main import COMMANDS, Shell, app
from sonofix.files import Problem, RecordingError

runner = CliRunner()


def test_help_names_every_command():
    for option in ("--help", "-h"):
        told = runner.invoke(app, [option])
        assert told.exit_code == 0
        for command in ("run", "check", "simulate", "score", "demo"):
            assert f"\n  {command} " in told.stdout


def test_version():
    told = runner.invoke(app, ["--version"])
    assert told.exit_code == 0
    assert told.stdout.startswith("sonofix 0.")


def test_the_package_is_a_command_too():
    told = subprocess.run([sys.executable, "-m", "sonofix", "--version"], capture_output=True, text=True, check=True)
    assert told.stdout.startswith("sonofix 0.")


def test_unknown_command_is_a_usage_mistake():
    told = runner.invoke(app, ["rum"])
    assert told.exit_code == 2
    assert "rum" in told.stderr


def raising(error: BaseException) -> typer.Typer:
    """The shell with one command, which goes wrong."""
    shell = typer.Typer(cls=Shell, pretty_exceptions_enable=False, rich_markup_mode=None)

    @shell.callback()
    def options(debug: bool = False) -> None:
        pass

    @shell.command()
    def go() -> None:
        raise error

    return shell


TWO = [
    Problem("site.toml", "beacon 2 id", "B1", "stands there twice; rename one"),
    Problem("sync.csv", "", None, "empty"),
]


@pytest.mark.parametrize(
    ("error", "code", "lines"),
    [
        (RecordingError(TWO), 2, ['site.toml: beacon 2 id = "B1": stands there twice; rename one', "sync.csv: empty"]),
        (ValueError("rate_hz = 0;\n it must be positive"), 2, ["rate_hz = 0; it must be positive"]),
        (OSError(errno.ENOSPC, "No space left on device", "out/a.csv"), 2, ["out/a.csv: No space left on device"]),
        (PermissionError(errno.EACCES, "Permission denied", "out"), 2, ["out: Permission denied"]),
        (KeyboardInterrupt(), 130, ["stopped"]),
        (Stopped("stopped; out holds the first 3 epochs"), 130, ["stopped; out holds the first 3 epochs"]),
    ],
)
def test_errors_become_lines(error, code, lines):
    told = runner.invoke(raising(error), ["go"])
    assert told.exit_code == code
    assert told.stderr.splitlines() == lines
    assert told.stdout == ""


def test_a_mistake_of_the_program_is_owned():
    told = runner.invoke(raising(KeyError("beacon")), ["go"])
    assert told.exit_code == 1
    assert told.stderr.startswith("mistake in sonofix: KeyError: 'beacon'\n")
    assert "Traceback" not in told.stderr


def test_debug_shows_where():
    told = runner.invoke(raising(ValueError("here")), ["--debug", "go"])
    assert isinstance(told.exception, ValueError)


def _fastest(command: list[str], times: int = 5) -> float:
    def once() -> float:
        start = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        return time.perf_counter() - start

    return min(once() for _ in range(times))


BARE = """
import dataclasses, json, rich, typer
app = typer.Typer(rich_markup_mode=None, pretty_exceptions_enable=False)
app.command()(lambda: None)
app(["--help"])
"""


def test_help_is_quick():
    """Beside a bare command line of the same library, help costs next to nothing."""
    floor_s = _fastest([sys.executable, "-c", BARE])
    help_s = _fastest([sys.executable, "-c", "from sonofix.cli.main import main; main()", "--help"])
    assert help_s < 1.6 * floor_s + 0.05


def test_help_needs_no_heavy_library():
    code = """
import sys
from typer.testing import CliRunner
from sonofix.cli.main import app
assert CliRunner().invoke(app, ["run", "--help"]).exit_code == 0
heavy = {"numpy", "scipy", "numba", "matplotlib", "soundfile", "sonofix.records", "sonofix.site"} & set(sys.modules)
sys.exit(", ".join(sorted(heavy)) or 0)
"""
    told: Any = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_listed_by_its_own_first_line(name):
    listed = " ".join(runner.invoke(app, ["--help"]).output.split())
    told = " ".join(runner.invoke(app, [name, "--help"]).output.split())
    assert COMMANDS[name] in listed
    assert COMMANDS[name] in told
