"""A burst learnt from a made-up bench, against the truth; and every recording that must be refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sonofix.channel import Line, simulate
from sonofix.records import Calibration, Floats, Waveform
from sonofix.signals.interpolate import sample
from sonofix.signals.waveform import waveforms_of
from sonofix.site import Site
from sonofix.survey.burst import calibrate, placed_distance_m
from survey.made_bench import CODE, DELAY_S, OTHER, SPEED_MPS, bench, distorted, record

B2 = {"id": "B2", "position_m": [0.0, 1.0, 1.0], "code": OTHER}


def late_s(a: Waveform, b: Waveform) -> tuple[float, float]:
    """How much later `a` stands than `b`, by the best correlation of their envelopes; and that correlation."""
    tau = np.linspace(-5e-4, b.duration_s + 2e-3, 8000)
    ours = sample(a.envelope, a.rate_hz, a.start_s, tau)

    def alike(shift: float) -> float:
        theirs = sample(b.envelope, b.rate_hz, b.start_s, tau - shift)
        return float(np.abs(np.vdot(ours, theirs)) / np.linalg.norm(ours) / np.linalg.norm(theirs))

    coarse = np.arange(-4e-4, 4e-4, 4e-6)
    top = coarse[int(np.argmax([alike(s) for s in coarse]))]
    shifts = top + np.linspace(-6e-6, 6e-6, 25)
    fit = np.polynomial.Polynomial.fit(shifts, [alike(s) for s in shifts], 2)
    best = float(fit.deriv().roots()[0].real)
    return best, alike(best)


def total_error_s(learnt: Calibration, true: Site) -> float:
    """What the learnt burst and its delay together put into a range: they may share it as they like."""
    assert learnt.delay_s is not None
    later, alike = late_s(learnt.waveform, waveforms_of(true)["B1"])
    assert alike > 0.999
    return learnt.delay_s + later - true.beacon("B1").delay_s


@pytest.mark.parametrize(("rate_hz", "within_s"), [(96e3, 1e-6), (192e3, 3e-7)])
def test_burst_and_delay_are_learnt(rate_hz: float, within_s: float) -> None:
    """3e-7 s are 0.1 mm; at 96 kHz what lies beyond half the rate folds back into the burst's edges."""
    true = distorted()
    learnt = calibrate(record(true, bench(), rate_hz=rate_hz), "B1", "M")
    assert abs(total_error_s(learnt, true)) < within_s
    # the nominal burst would have been this far off
    assert learnt.delay_s is not None
    assert learnt.delay_s > DELAY_S + 5e-5
    assert learnt.match is not None
    assert 0.95 < learnt.match < 0.995
    assert learnt.heard == 16
    assert not learnt.left_out
    assert learnt.distance_m == pytest.approx(1.0)
    assert learnt.amplitude == pytest.approx(0.3 * 10 ** (-1.3 / 20), rel=0.02)
    assert learnt.snr_gain_db == pytest.approx(10 * np.log10(16), abs=0.1)
    assert not learnt.flags


def test_loudness_over_noise_is_as_made() -> None:
    true = bench()
    quiet, loud = (calibrate(record(true, true, noise_sd=sd), "B1", "M") for sd in (4e-3, 4e-4))
    assert loud.snr_db - quiet.snr_db == pytest.approx(20.0, abs=0.3)
    # white noise spread evenly to half the rate, of which the band is a part
    share = (quiet.band_hz[1] - quiet.band_hz[0]) / 96e3
    w = waveforms_of(true)["B1"]
    burst_s = w.duration_s + 2.5e-3
    power = 0.5 * quiet.amplitude**2 * float(np.sum(np.abs(w.envelope) ** 2)) / w.rate_hz / burst_s
    assert quiet.snr_db == pytest.approx(10 * np.log10(power / (4e-3**2 * share)), abs=0.5)
    assert quiet.noise_rms == pytest.approx(4e-3 * np.sqrt(share), rel=0.1)


def test_deviation_of_the_delay_is_honest_and_falls_with_the_root_of_the_bursts() -> None:
    """12 recordings each: the mean square of error over deviation lies in the 99.8 % band of chi-square, 12."""
    true = bench()
    sds: dict[int, Floats] = {}
    for bursts in (8, 32):
        runs = [
            calibrate(record(true, true, bursts=bursts, noise_sd=2e-2, seed=7 + i), "B1", "M", gate_s=None)
            for i in range(12)
        ]
        # without noise the delay is what the nominal burst's own alignment makes of it
        bare = calibrate(record(true, true, bursts=8, noise_sd=1e-5), "B1", "M", gate_s=None).delay_s
        assert bare is not None
        assert abs(bare) < 3e-8
        ratio = [((r.delay_s or 0.0) - bare) / (r.delay_sd_s or np.nan) for r in runs]
        assert 2.2 / 12 < np.mean(np.square(ratio)) < 32.9 / 12
        sds[bursts] = np.array([r.delay_sd_s for r in runs], float)
    # each deviation rests on 7 degrees of freedom or 31, so that the ratio of the means is good to a tenth
    assert np.mean(sds[8]) / np.mean(sds[32]) == pytest.approx(2.0, rel=0.25)


def test_distance_and_air_are_in_the_whole_deviation() -> None:
    told = bench().model_copy(
        update={"air": Site.model_validate({"beacon": [{"id": "x", "position_m": [0, 0, 0]}]}).air}
    )
    learnt = calibrate(record(distorted(), told), "B1", "M", distance_sd_m=2e-3)
    c = told.sound_speed_mps
    wanted = np.hypot(2e-3 / c, 0.607 / c**2)
    assert learnt.delay_total_sd_s == pytest.approx(np.hypot(wanted, learnt.delay_sd_s or 0.0), rel=1e-6)
    stated = calibrate(record(distorted(), bench()), "B1", "M", distance_sd_m=2e-3)
    assert stated.delay_total_sd_s == pytest.approx(2e-3 / SPEED_MPS, rel=1e-3)


def test_a_measured_distance_takes_the_place_of_the_stated_one() -> None:
    recording = record(bench(), bench())
    near, far = (calibrate(recording, "B1", "M", distance_m=d).delay_s for d in (0.9, 1.1))
    assert near is not None
    assert far is not None
    assert near - far == pytest.approx(0.2 / SPEED_MPS, abs=1e-12)


def test_the_room_is_left_out() -> None:
    """Floor and walls half as loud as life: the plain average holds them, the gated one does not."""
    room = [[-1.2, -1.5, 0.0], [3.0, 1.5, 3.0]]
    true = distorted(bounds_m=room)
    recording = record(true, bench(), echo=0.6)
    gated = calibrate(recording, "B1", "M")
    plain = calibrate(recording, "B1", "M", gate_s=None)
    clean = [late_s(c.waveform, waveforms_of(true)["B1"])[1] for c in (gated, plain)]
    assert clean[0] > 0.9995
    assert clean[1] < 0.97
    assert gated.gate_s == pytest.approx(2.25e-3)
    assert plain.gate_s is None
    # the floor's way is 2.236 m
    first = min(gated.echoes, key=lambda path: path.delay_s)
    assert first.delay_s == pytest.approx(1.236 / SPEED_MPS, abs=3e-5)
    assert first.gain_db == pytest.approx(20 * np.log10(0.6 / 2.236) - 1.3 * 1.236, abs=2.5)


def test_a_free_running_beacon_tells_its_clock() -> None:
    recording = record(distorted(synchronised=False), bench(synchronised=False), beacon_drift={"B1": 30e-6}, bursts=20)
    learnt = calibrate(recording, "B1", "M")
    assert learnt.delay_s is None
    assert learnt.delay_sd_s is None
    assert learnt.pace.rate == pytest.approx(30e-6, abs=max(5 * learnt.pace.rate_sd, 1e-12))
    assert learnt.pace.rate_sd < 1e-7
    assert learnt.pace.drift_per_s is None
    # a second that is longer makes a lower carrier
    assert learnt.stretch == pytest.approx(-30e-6, abs=1e-7)
    # white time errors of that size
    assert learnt.pace.allan[0] == pytest.approx(np.sqrt(3) * learnt.pace.jitter_s / 0.1, rel=0.5)


@pytest.mark.parametrize("modulation", ["ask", "bpsk"])
def test_a_burst_of_unknown_code(modulation: str) -> None:
    true = distorted(modulation=modulation)
    learnt = calibrate(record(true, bench(code=None, modulation=modulation)), "B1", "M")
    assert learnt.nominal is None
    assert learnt.match is None
    assert learnt.response is None
    assert abs(total_error_s(learnt, true)) < 5e-7
    shorter = calibrate(record(true, bench(code=None, modulation=modulation)), "B1", "M", length_s=8e-3)
    assert len(shorter.burst.samples) < 0.8 * len(learnt.burst.samples)


def test_a_chirp_is_learnt() -> None:
    code = {"family": "chirp", "start_hz": 38e3, "stop_hz": 42e3, "duration_s": 15e-3}
    true = distorted(code=code)
    learnt = calibrate(record(true, bench(code=code)), "B1", "M")
    assert abs(total_error_s(learnt, true)) < 5e-7
    assert learnt.stretch is None


def test_a_reference_is_learnt_afresh() -> None:
    """A recorded burst as the nominal one: what was learnt before is found again, with no delay left."""
    true = distorted()
    first = calibrate(record(true, bench()), "B1", "M")
    code = {"reference": "B1.flac", "distance_m": first.flight_m, "start_s": first.start_s}
    again = replace(record(true, bench(code=code), seed=3), references={"B1": first.burst})
    second = calibrate(again, "B1", "M")
    assert second.match is not None
    assert second.match > 0.9999
    assert second.delay_s == pytest.approx(first.delay_s, abs=1e-7)
    assert second.response is None


def test_distances_that_the_site_file_knows() -> None:
    site = bench(distance_m=1.7)
    assert placed_distance_m(record(site, site), "B1", "M") == pytest.approx(1.7)
    carried = Site.model_validate(
        {
            "vehicle": [{"id": "v"}],
            "beacon": [{"id": "A", "vehicle": "v", "lever_arm_m": [0, 0, 1]}, {"id": "B", "position_m": [0, 0, 0]}],
            "microphone": [{"id": "M", "channel": 0, "vehicle": "v", "lever_arm_m": [1, 0, 1]}],
        }
    )
    recording = replace(record(site, site), site=carried)
    assert placed_distance_m(recording, "A", "M") == pytest.approx(1.0)
    assert placed_distance_m(recording, "B", "M") is None


def disturbed(recording: Any, spoil: Any) -> Any:
    """Let `spoil` change the samples, all at once."""
    whole = np.concatenate(list(recording.blocks(1 << 16)))
    spoil(whole)
    return replace(recording, blocks=lambda n: (whole[i : i + n] for i in range(0, len(whole), n)))


def test_disturbed_bursts_are_left_out() -> None:
    true = distorted()
    recording = record(true, bench(), bursts=24)

    def spoil(samples: Floats) -> None:
        for burst, kind in ((3, "click"), (9, "tone"), (14, "faint"), (20, "click")):
            at = round(burst * 0.1 * 192e3) + 2000
            if kind == "click":
                samples[at : at + 3] += 0.6
            elif kind == "tone":
                samples[at : at + 1500, 0] += 0.1 * np.sin(2 * np.pi * 40.3e3 / 192e3 * np.arange(1500))
            else:
                samples[at - 3000 : at + 5000] *= 0.5

    learnt = calibrate(disturbed(recording, spoil), "B1", "M")
    assert learnt.left_out == {"disturbed": 3, "of another strength": 1}
    assert abs(total_error_s(learnt, true)) < 3e-7
    assert not learnt.pace.used[[3, 9, 14, 20]].any()


def test_a_burst_out_of_time_is_left_out() -> None:
    recording = record(bench(), bench(), bursts=24)

    def spoil(samples: Floats) -> None:
        at = round(1.1 * 192e3)
        samples[at : at + 15000] = samples[at - 4 : at + 14996].copy()  # 21 µs late

    learnt = calibrate(disturbed(recording, spoil), "B1", "M")
    assert learnt.left_out == {"out of time": 1}
    assert not learnt.pace.used[11]
    assert learnt.pace.late_s[11] == pytest.approx(4 / 192e3, rel=0.05)


def moving(speed_mps: float, code: dict[str, Any] = CODE, **more: Any) -> Any:
    told = bench(code, **more)
    true = told.model_dump(by_alias=True, exclude_none=True)
    true |= {"vehicle": [{"id": "v"}], "microphone": [{"id": "M", "channel": 0, "vehicle": "v"}]}
    site = Site.model_validate(true)
    made, _ = simulate(
        site,
        {"v": Line((1.0, 0.0, 1.0), (speed_mps, 0.0, 0.0))},
        rate_hz=192e3,
        duration_s=1.7,
        waveforms=waveforms_of(site),
        level=0.3,
        noise_sd=1e-3,
    )
    return replace(made, site=told)


@pytest.mark.parametrize("speed_mps", [0.02, 0.2, -0.4])
def test_a_moving_recording_is_refused(speed_mps: float) -> None:
    with pytest.raises(ValueError, match="something moved"):
        calibrate(moving(speed_mps), "B1", "M")


def test_faster_motion_is_told_from_silence() -> None:
    """A code long enough that at 1.2 m/s nothing of it correlates at rest."""
    code = {"family": "m-sequence", "degree": 8, "taps": [1, 2, 7]}
    with pytest.raises(ValueError, match=r"heard moving at some 1\.[12]\d m/s; a burst is learnt at rest"):
        calibrate(moving(1.2, code), "B1", "M")


def test_a_slow_creep_is_mentioned() -> None:
    learnt = calibrate(moving(0.002), "B1", "M")
    assert any("the distance seems to change by 3" in flag for flag in learnt.flags)


def test_silence_is_told() -> None:
    with pytest.raises(ValueError, match="beacon B1 at microphone M: silent"):
        calibrate(record(bench(), bench(), beacons=()), "B1", "M")
    both = bench(others=(B2,))
    with pytest.raises(ValueError, match=r"silent|the code of beacon B2"):
        calibrate(record(both, both, beacons=("B2",)), "B1", "M")
    with pytest.raises(ValueError, match="no burst stands out of the noise"):
        calibrate(record(bench(), bench(code=None), beacons=()), "B1", "M")


def test_another_beacon_than_named() -> None:
    """At 31 chips one code passes for another in the search, but not when it is compared."""
    short, other = ({"family": "m-sequence", "degree": 5, "taps": taps} for taps in ([2], [3]))
    site = bench(short, others=(B2 | {"code": other},))
    with pytest.raises(ValueError, match="what bursts there is the code of beacon B2"):
        calibrate(record(site, site, beacons=("B2",)), "B1", "M")


def test_two_beacons_at_once() -> None:
    both = bench(others=(B2,))
    with pytest.raises(ValueError, match="beacons B1 and B2 sound at once"):
        calibrate(record(both, both, beacons=("B1", "B2"), level=0.2), "B1", "M")
    faint = calibrate(record(both, both, beacons=("B1", "B2"), level={"B1": 0.3, "B2": 0.04}), "B1", "M")
    assert any(flag.startswith("beacon B2 sounds at the same time") for flag in faint.flags)
    turns = bench(others=(B2 | {"offset_s": 0.05},))
    assert not calibrate(record(turns, turns, beacons=("B1", "B2"), level=0.2), "B1", "M").flags


def test_too_few_clipped_and_impossible() -> None:
    with pytest.raises(ValueError, match="2 bursts heard; at least 3 are needed"):
        calibrate(record(bench(), bench(), bursts=2), "B1", "M")
    assert any("only 5 bursts" in flag for flag in calibrate(record(bench(), bench(), bursts=5), "B1", "M").flags)
    with pytest.raises(ValueError, match="16 of 16 bursts are clipped; lower the gain"):
        calibrate(record(bench(), bench(), clip=0.2), "B1", "M")
    with pytest.raises(ValueError, match="needs samples faster than"):
        calibrate(replace(record(bench(), bench()), rate_hz=64e3), "B1", "M")
    with pytest.raises(ValueError, match="does not fit into the period"):
        calibrate(record(bench(), bench(period_s=0.016)), "B1", "M")
    with pytest.raises(ValueError, match="no samples"):
        calibrate(replace(record(bench(), bench()), blocks=None), "B1", "M")


def test_long_recordings_are_thinned_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sonofix.survey.burst.MOST_KEPT", 8000)
    learnt = calibrate(record(bench(), bench(), bursts=40), "B1", "M")
    assert learnt.left_out["not needed"] > 20
    assert any("one burst in" in flag for flag in learnt.flags)
    assert np.ptp(learnt.pace.scheduled_s) > 3.0
