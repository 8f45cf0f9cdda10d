"""The third seed's figures 2, 4 and 5: LMS on its own numbers, and detection curves of it and of our receiver.

The seed's samples are 400 per microsecond over one period of the carrier; its exponents, step size, taps and noise are
not given, so that several are tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.adaptive import MATCH_BAND_V, Announced, Filtered, desired, lms, mean_magnitude, nlms, rls
from sonofix.records import Curve, Finding, Floats, Panel, Sheet
from sonofix.studies import robots_bursts as bursts
from sonofix.studies.work import batches

RATE_HZ, WINDOW_S = 4e8, 2.5e-5
CARRIER_HZ, VOLTS = 40e3, 5.0
CLAIM_PRESENT, CLAIM_ABSENT = "4.956 V", "4.126 V"

NOISE_V, TAPS, STEP = 3.0, 8, 1e-3

SLOW_HZ, SLOW_RATE_HZ, SLOW_S, SLOW_STEP = 1.0, 200.0, 4.0, 1e-4
"""Of figure 2, whose sampling is not given either."""

SHOWN = 20
"""One sample in so many is drawn."""

STEPS = 10.0 ** np.arange(-6.0, -2.4, 0.25)
"""Step sizes looked over, in 1/V²."""

WEAK_DB, TONED_DB, CLEAR_DB = -14.0, -6.0, 0.0
"""Bursts over the noise in 4 kHz: in the curve with noise alone, in that under the tone, where misses are counted."""

TONE_DB = 20.0
"""Of the tone over a burst's mean power."""

BATCH, BATCHES = 25, 10
"""Trials in a batch, and batches that one run from waveforms has; of each curve, two in five of them."""

FALSE_ALARMS = np.geomspace(1e-3, 1.0, 61)
TOLD_AT = 1e-2
"""Share of false alarms at which detection is stated."""


@dataclass(frozen=True, slots=True)
class Setting:
    """A filter on the seed's numbers: its name, what it does, the noise, and the tone's phase against the burst."""

    name: str
    filtered: Callable[[Floats, Floats], Filtered]
    noise_v: float = NOISE_V
    phase_rad: float = 0.0
    claims: tuple[str, str] = ("", "")


SETTINGS = (
    Setting(
        f"LMS, {TAPS} taps, step 1e-3, 3 V", lambda x, d: lms(x, d, STEP, TAPS), claims=(CLAIM_PRESENT, CLAIM_ABSENT)
    ),
    Setting("LMS, 32 taps, step 1e-4, 1 V", lambda x, d: lms(x, d, 1e-4, 32), 1.0, 0.0, ("4.98 V", "4.55 V")),
    Setting("tone ¼ period off", lambda x, d: lms(x, d, STEP, TAPS), NOISE_V, np.pi / 2, ("4.1 V", "")),
    Setting("NLMS, 8 taps, step 0.01, 3 V", lambda x, d: nlms(x, d, 0.01, TAPS)),
    Setting("RLS, 8 taps, 3 V", lambda x, d: rls(x, d, TAPS)),
)


@dataclass(frozen=True, slots=True, eq=False)
class Means:
    """Mean magnitudes of a setting's outputs in V, with the burst and without, (runs, 1)."""

    present: Floats
    absent: Floats


def heard(time_s: Floats, present: bool, noise_v: float, phase_rad: float, rng: np.random.Generator) -> Floats:
    """Samples of figure 4 (with the burst) or 5: a tone of the burst's own frequency, and white noise."""
    tone = VOLTS * np.sin(2 * np.pi * CARRIER_HZ * time_s + phase_rad)
    burst = desired(Announced(CARRIER_HZ, VOLTS), 1.0, time_s) if present else 0.0
    return burst + tone + noise_v * rng.standard_normal(len(time_s))


def window() -> Floats:
    """Instants of the seed's window (10 000,)."""
    return np.arange(round(WINDOW_S * RATE_HZ)) / RATE_HZ


def simulated(numbers: range, seed: int, setting: Setting) -> Means:
    """Compute runs of a setting by their numbers, each with a generator of its own."""
    time_s = window()
    wanted = desired(Announced(CARRIER_HZ, VOLTS), 1.0, time_s)
    means = np.empty((2, len(numbers), 1))
    for i, run in enumerate(numbers):
        rng = np.random.default_rng([seed, 4, run])
        for j, present in enumerate((True, False)):
            samples = heard(time_s, present, setting.noise_v, setting.phase_rad, rng)
            means[j, i] = mean_magnitude(setting.filtered(samples, wanted).output)
    return Means(means[0], means[1])


class Detection:
    """The study in progress."""

    def __init__(self, runs: int, seed: int, waveforms: int) -> None:
        self._wanted, self._seed = runs, seed
        self._batches = waveforms * BATCHES
        self._means: dict[str, list[Means]] = {}
        self._curves: dict[float | None, list[bursts.Scores]] = {}
        self._decided: list[tuple[Floats, Floats]] = []

    def work(self) -> Iterator[tuple[str, float]]:
        """Compute the seed's numbers, then bursts through the receiver."""
        for k, setting in enumerate(SETTINGS):
            done = self._means.setdefault(setting.name, [])
            for numbers in batches(self._wanted):
                done.append(simulated(numbers, self._seed, setting))
                yield "on the seed's numbers", (k + numbers.stop / self._wanted) / len(SETTINGS)
        if not self._batches:
            return
        clear = bursts.bench(CLEAR_DB)
        for k in range(self._batches):
            self._decided.append(bursts.decided(clear, k, self._seed, BATCH, TONE_DB))
            yield "bursts under a tone", (k + 1) / self._batches
        for snr_db, tone_db in _CURVES:
            bench, done = bursts.bench(snr_db), self._curves.setdefault(tone_db, [])
            count = 2 * self._batches // 5
            for k in range(count):
                done.append(bursts.scored(bench, k, self._seed, BATCH, tone_db))
                yield f"detection curve, {_told(tone_db)}", (k + 1) / count

    def sheet(self) -> Sheet | None:
        """Show what is finished."""
        if not any(self._means.values()):
            return None
        panels = [self._slow(), self._printed(True), self._printed(False), self._scan()]
        panels += [
            _curve_panel(snr_db, tone_db, bursts.joined(done))
            for snr_db, tone_db in _CURVES
            if (done := self._curves.get(tone_db))
        ]
        note = "A 40 kHz burst of 5 V beside a 40 kHz tone of 5 V and noise" + (
            "; right: coded and plain bursts of equal energy, 64 ms" if self._curves else ""
        )
        columns = 3 if self._curves else 2
        return Sheet("Robots: a burst picked out of noise", note, columns, tuple(panels), self._findings())

    def _findings(self) -> tuple[Finding, ...]:
        out: list[Finding] = []
        for setting in SETTINGS:
            done = self._means.get(setting.name)
            if not done:
                continue
            for kind, claim in zip(("present", "absent"), setting.claims, strict=True):
                means = np.concatenate([getattr(part, kind) for part in done])
                sd = float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else None
                out.append(
                    Finding(f"{setting.name}: {kind}", "mean |y|", float(means.mean()), sd, "V", len(means), claim)
                )
            inside = [
                np.concatenate([np.abs(getattr(part, kind) - VOLTS) <= MATCH_BAND_V for part in done])
                for kind in ("present", "absent")
            ]
            out.append(_share(inside[0] & ~inside[1], setting.name, "told apart"))
        for snr_db, tone_db in _CURVES:
            if done := self._curves.get(tone_db):
                scores, case = bursts.joined(done), f"{_told(tone_db)}, {snr_db:+g} dB"
                out += [_detection(scores, name, case) for name in bursts.DETECTORS]
        if self._decided:
            missed, alarmed = (np.concatenate(each) for each in zip(*self._decided, strict=True))
            case = f"receiver, {_told(TONE_DB)}, {CLEAR_DB:+g} dB"
            for events, quantity in ((missed, "missed"), (alarmed, "false alarms")):
                # of fewer trials not even one without any event tells so little
                claim = "≤ 0.1 %" if bursts.at_most(0, events.size) <= 1e-3 else ""
                out.append(_share(events > 0, case, quantity, claim))
                most = bursts.at_most(int(events.sum()), events.size)
                out.append(Finding(case, f"{quantity}, at most (95 %)", most, None, "", events.size, claim))
        return tuple(out)

    def _slow(self) -> Panel:
        time_s, wanted, noisy, filtered = _slowly(self._seed)
        curves = (
            Curve("with noise", time_s, noisy, "raw"),
            Curve("filtered", time_s, filtered, "result"),
            Curve("desired", time_s, wanted, "truth"),
        )
        settled = slice(len(time_s) // 2, None)
        before, after = (float(np.sqrt(np.mean((v - wanted)[settled] ** 2))) for v in (noisy, filtered))
        note = f"rms error {before:.2f} V before, {after:.2f} V after"
        return Panel("Figure 2", note, "time, s", "V", curves, (-14.0, 26.0))

    def _printed(self, present: bool) -> Panel:
        time_s = window()
        wanted = desired(Announced(CARRIER_HZ, VOLTS), 1.0, time_s)
        samples = heard(time_s, present, NOISE_V, 0.0, np.random.default_rng([self._seed, 4, 0, int(present)]))
        output = SETTINGS[0].filtered(samples, wanted).output
        shown, note = slice(None, None, SHOWN), f"mean |y| {mean_magnitude(output):.3f} V"
        curves = (
            Curve("heard", 1e6 * time_s[shown], samples[shown], "raw"),
            Curve("filtered", 1e6 * time_s[shown], output[shown], "result"),
            Curve("desired", 1e6 * time_s[shown], wanted[shown], "truth"),
        )
        title = "Figure 4: a burst" if present else "Figure 5: none"
        return Panel(title, note, "time, µs", "V", curves, (-22.0, 34.0))

    def _scan(self) -> Panel:
        """Mean magnitudes by step size, from one run each."""
        time_s = window()
        wanted = desired(Announced(CARRIER_HZ, VOLTS), 1.0, time_s)
        curves = []
        for taps, present, kind in _SCANNED:
            samples = heard(time_s, present, NOISE_V, 0.0, np.random.default_rng([self._seed, 5, int(present)]))
            outputs = [lms(samples, wanted, float(step), taps) for step in STEPS]
            means = [np.inf if f.diverged else mean_magnitude(f.output) for f in outputs]
            # what grows beyond the picture is on its way to infinity
            means = [mean if mean < 2 * VOLTS else np.nan for mean in means]
            curves.append(
                Curve(f"{taps} taps, {'a burst' if present else 'none'}", np.log10(STEPS), np.array(means), kind)
            )
        edges = np.log10(STEPS[[0, -1]])
        band = Curve(
            "matched between", np.array([*edges, np.nan, *edges]), np.array([4.5, 4.5, np.nan, 5.5, 5.5]), "bound"
        )
        return Panel(
            "Amplitude matching", "by step size", "log₁₀ of the step", "mean |y|, V", (*curves, band), (0.0, 12.0)
        )


_SCANNED: tuple[tuple[int, bool, Literal["truth", "raw", "alone", "result"]], ...] = (
    (TAPS, True, "result"),
    (TAPS, False, "raw"),
    (32, True, "truth"),
    (32, False, "alone"),
)

_KINDS: dict[str, Literal["truth", "raw", "alone", "result", "bound"]] = {
    bursts.TOLD: "truth",
    bursts.SEARCHED: "result",
    "LMS": "raw",
    "NLMS": "alone",
    "RLS": "bound",
}
"""How each detector's curve is drawn."""

_CURVES: tuple[tuple[float, float | None], ...] = ((WEAK_DB, None), (TONED_DB, TONE_DB))


def _told(tone_db: float | None) -> str:
    return "noise alone" if tone_db is None else f"tone {tone_db:+g} dB"


def _detection(scores: bursts.Scores, name: str, case: str) -> Finding:
    """Share of bursts detected at `TOLD_AT` false alarms, at a threshold that all batches share."""
    threshold = np.quantile(scores.absent[name], 1.0 - TOLD_AT, method="higher")
    return _share(scores.present[name] > threshold, f"{case}: {name}", f"detected at {TOLD_AT:.0%}")


def _share(events: NDArray[np.bool_], case: str, quantity: str, claim: str = "") -> Finding:
    """Share of independent trials in which something happened, with its binomial standard error."""
    p, n = float(np.mean(events)), events.size
    return Finding(case, quantity, p, float(np.sqrt(p * (1 - p) / n)), "", n, claim)


def _curve_panel(snr_db: float, tone_db: float | None, scores: bursts.Scores) -> Panel:
    trials = scores.absent[bursts.TOLD].size
    false_alarms = FALSE_ALARMS[FALSE_ALARMS * trials >= 1.0]
    curves = []
    for name, kind in _KINDS.items():
        # no miss at all cannot be drawn by its logarithm: half a one
        missed = np.maximum(1.0 - bursts.detected(scores, name, false_alarms), 0.5 / trials)
        curves.append(Curve(name, np.log10(false_alarms), missed, kind))
    note, title = f"bursts of {snr_db:g} dB in 4 kHz", _told(tone_db)
    limits, axes = (0.3 / trials, 10.0), ("log₁₀ of false alarms", "missed")
    return Panel(title[0].upper() + title[1:], note, *axes, tuple(curves), limits, logarithmic=True)


def _slowly(seed: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Figure 2: instants, the desired sinusoid, it in noise, and filtered (n,)."""
    time_s = np.arange(round(SLOW_S * SLOW_RATE_HZ)) / SLOW_RATE_HZ
    wanted = desired(Announced(SLOW_HZ, VOLTS, "sine"), 1.0, time_s)
    noisy = wanted + NOISE_V * np.random.default_rng([seed, 3]).standard_normal(len(time_s))
    return time_s, wanted, noisy, lms(noisy, wanted, SLOW_STEP, 32).output
