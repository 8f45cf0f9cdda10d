"""What the documentation says is so: its code runs, its links lead somewhere, its commands, columns and files exist."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from sonofix.cli.main import COMMANDS, app
from sonofix.files import read_site
from sonofix.files.tables import LAYOUTS
from sonofix.files.writing import COLUMNS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]


def blocks(page: Path, language: str) -> list[str]:
    """Fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="session")
def demonstration(tmp_path_factory) -> Path:
    """Return a folder that holds `demo/`, as `sonofix demo` leaves it, though short."""
    place = tmp_path_factory.mktemp("reader")
    told = CliRunner().invoke(app, ["demo", "-o", str(place / "demo"), "--seconds", "1"])
    assert told.exit_code == 0, told.stderr
    return place


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python")], ids=lambda p: p.name)
def test_python_runs_and_prints_what_is_shown(page, demonstration, monkeypatch, capsys):
    monkeypatch.chdir(demonstration)
    names: dict = {"__name__": "reader"}
    for code in blocks(page, "python"):
        exec(compile(code, page.name, "exec"), names)
        printed = capsys.readouterr().out
        following = page.read_text("utf-8").split(f"```python\n{code}```", 1)[1].lstrip()
        if following.startswith("```text\n"):
            assert printed == following.removeprefix("```text\n").split("```", 1)[0]


def test_the_readme_shows_five_lines_from_a_recording_to_a_track(demonstration):
    code = blocks(ROOT / "README.md", "python")[0]
    assert len([line for line in code.splitlines() if line.strip()]) == 5
    told = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=demonstration, capture_output=True, text=True, check=True
    )
    rows = told.stdout.splitlines()
    assert len(rows) == 4  # a second of four epochs
    assert all(" agv " in row for row in rows)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_relative_links_lead_somewhere(page):
    text = re.sub(r"^```.*?^```$", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if not link.startswith("http")]
    for link in links:
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{page.name}: {link}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", target.read_text("utf-8"), re.MULTILINE)
            assert anchor in [re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in headings]


def test_every_page_is_reached_from_the_readme():
    readme = (ROOT / "README.md").read_text("utf-8")
    for page in PAGES[1:]:
        assert f"(docs/{page.name})" in readme


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_and_their_options_exist(page):
    shell = typer.main.get_command(app)
    text = page.read_text("utf-8")
    code = re.findall(r"`([^`\n]+)`", text) + [line for block in blocks(page, "sh") for line in block.splitlines()]
    for line in code:
        # a line may hold several commands, and comments
        for call in re.findall(r"(?:^|[;&] *)sonofix ([^#;&]*)", line.strip()):
            name, *rest = call.split() or [""]
            if name in ("COMMAND", "--help", "--version", "--debug"):
                continue
            assert name in COMMANDS, f"{page.name}: sonofix {call}"
            params = shell.get_command(typer.Context(shell), name).params
            options = {option for p in params for option in (*p.opts, *p.secondary_opts)} | {"--help"}
            for word in rest:
                if re.fullmatch(r"--?[a-z][a-z-]*", word):
                    assert word in options, f"{page.name}: sonofix {call}"


def test_every_command_is_in_the_readme():
    readme = (ROOT / "README.md").read_text("utf-8")
    for name in COMMANDS:
        assert f"`sonofix {name}" in readme


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_make_targets_exist(page):
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    text = page.read_text("utf-8")
    code = re.findall(r"`([^`\n]+)`", text) + [line for block in blocks(page, "sh") for line in block.splitlines()]
    for name in [m for line in code for m in re.findall(r"^make ([a-z]+)", line)]:
        assert name in targets, f"{page.name}: make {name}"


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "toml")], ids=lambda p: p.name)
def test_site_files_shown_are_right(page, tmp_path):
    for i, text in enumerate(blocks(page, "toml")):
        path = tmp_path / str(i) / "site.toml"
        path.parent.mkdir()
        path.write_text(text, "utf-8")
        assert read_site(path).beacons


def test_the_team_made_up_is_one_that_the_simulator_takes(tmp_path, monkeypatch):
    """The commands of docs/team.md, of a second and a half."""
    page = ROOT / "docs" / "team.md"
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks(page, "python")[0], page.name, "exec"), {"__name__": "reader"})
    simulate, copy, team = blocks(page, "sh")[0].splitlines()
    assert copy == "cp start.csv leaps/"
    words = simulate.replace("docs/leaps.toml", str(ROOT / "docs" / "leaps.toml")).split()[1:]
    words[words.index("--duration") + 1] = "1.5"
    made = CliRunner().invoke(app, words)
    assert made.exit_code == 0, made.output
    (tmp_path / "leaps" / "start.csv").write_bytes((tmp_path / "start.csv").read_bytes())
    told = CliRunner().invoke(app, [*team.split()[1:], "--no-plot"])
    assert told.exit_code == 0, told.output
    assert "never" not in told.stdout


def test_site_file_codes_shown_in_lines_are_right(tmp_path):
    text = (ROOT / "docs" / "formats.md").read_text("utf-8")
    codes = re.findall(r"^\| `(\{.+?\})` \|", text, re.MULTILINE)
    assert len(codes) == 6
    head = "format = 1\n[schedule]\nperiod_s = 1.0\n[signal]\ncarrier_hz = 40e3\ncycles_per_chip = 10\n"
    rows = [f'[[beacon]]\nid = "B{i}"\nposition_m = [{i}, 0, 3]\ncode = {code}\n' for i, code in enumerate(codes)]
    (tmp_path / "site.toml").write_text(head + "".join(rows), "utf-8")
    assert len(read_site(tmp_path / "site.toml").coded_beacons) == 6


def test_the_reference_names_every_file_and_column():
    text = (ROOT / "docs" / "formats.md").read_text("utf-8")
    for name, header in COLUMNS.items():
        assert f"### {name}\n\n`{header}`" in text
    for stem, layout in LAYOUTS.items():
        (row,) = re.findall(rf"^\| `{stem}\.csv` \| (.*?) \|", text, re.MULTILINE)
        named = set(re.findall(r"\w+", " ".join(re.findall(r"`([^`]+)`", row))))
        assert named == {*layout.required, *layout.optional, *layout.one_of}


def test_the_reference_names_every_key_of_the_site_file():
    from sonofix.files.schema import site_schema

    schema = site_schema()
    shown = "\n".join(blocks(ROOT / "docs" / "formats.md", "toml")) + (ROOT / "docs" / "formats.md").read_text("utf-8")
    for part in (schema, *schema["$defs"].values()):
        for key in part["properties"]:
            assert re.search(rf"\b{key}\b", shown), key


def test_rooms_named_exist_and_existing_rooms_are_named():
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    named = set(re.findall(r"^\| \[`([\w./]+)`\]", text, re.MULTILINE))
    package = ROOT / "src" / "sonofix"
    there = {f"{p.name}/" for p in package.iterdir() if p.is_dir() and (p / "__init__.py").exists()}
    there |= {p.name for p in package.glob("*.py") if not p.name.startswith("__")}
    assert named == there


@pytest.mark.parametrize(("name", "most"), [("track.png", 600_000), ("explain.png", 250_000), ("team.png", 150_000)])
def test_the_pictures_are_there_and_small(name, most):
    picture = ROOT / "docs" / name
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size <= most
