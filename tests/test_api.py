"""The five lines that README and package docstring show, run as they stand on a recording of that name."""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import dedent

import pytest

import sonofix
from sonofix.channel import Line, simulate
from sonofix.files import write_recording
from sonofix.signals import codes
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site

README = Path(__file__).parents[1] / "README.md"


def shown(source: str) -> str:
    if source == "docstring":
        assert sonofix.__doc__ is not None
        return dedent("\n".join(line for line in sonofix.__doc__.splitlines() if line.startswith("    ")))
    found = re.search(r"^```python\n(.*?)^```", README.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    if found is None:
        pytest.skip("README.md shows no python")
    return found[1]


def record(folder: Path) -> None:
    site = Site.model_validate(
        {
            "air": {"sound_speed_mps": 343.2},
            "schedule": {"period_s": 0.2},
            "signal": {"carrier_hz": 15e3, "cycles_per_chip": 6, "bandwidth_hz": 4e3},
            "vehicle": [{"id": "agv", "z_m": 0.4}],
            "beacon": [
                {
                    "id": f"B{i}",
                    "position_m": place,
                    "code": {"family": "m-sequence", "degree": 7, "taps": list(codes.primitive_taps(7)[i])},
                }
                for i, place in enumerate([(0.1, 0.0, 3.0), (5.9, 0.2, 2.8), (6.0, 4.9, 3.1), (0.0, 5.0, 2.6)])
            ],
            "microphone": [{"id": "M", "channel": 0, "vehicle": "agv"}],
        }
    )
    motion = Line((1.5, 1.2, 0.4), (0.6, 0.4, 0.0))
    recording, truth = simulate(
        site, {"agv": motion}, rate_hz=48e3, duration_s=1.0, waveforms=waveforms_of(site), level=0.3, noise_sd=2e-3
    )
    write_recording(folder, recording, truth)


@pytest.mark.parametrize("source", ["docstring", "README"])
def test_shown_lines_run(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code = shown(source)
    named = re.search(r"""read_recording\(\s*["'](.+?)["']""", code)
    assert named is not None, code
    record(tmp_path / named[1])
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(code, source, "exec"), names)
    assert "recording" in names
    out = capsys.readouterr().out
    if "print" in code:
        # a line an epoch and vehicle, which says who and where
        assert len(out.strip().splitlines()) >= 4
        assert "agv" in out


def test_names_are_those_of_the_package() -> None:
    for name in sonofix.__all__:
        assert callable(getattr(sonofix, name))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'; it offers"):
        _ = sonofix.nonsense
