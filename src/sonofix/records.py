"""The types that cross a room's door.

SI units throughout; east-north-up frame; angles in radians counter-clockwise from east; times in seconds on the
recorder's clock, where sample 0 is time 0. A microphone is a *receiver*, a beacon an *emitter*; either may be fixed
or ride on a vehicle. Quantities that are not known are ``None``, never zero and never a silent NaN.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sonofix.site import Site

Floats = NDArray[np.floating]

FixStatus = Literal["ok", "too-few", "no-convergence", "inconsistent", "ambiguous"]
Source = Literal["fix", "fused", "predicted", "smoothed"]


@dataclass(frozen=True, slots=True, eq=False)
class Waveform:
    """One burst as a beacon sends it and a microphone hears it at rest: an envelope on a carrier.

    With τ the burst's own time, 0 at the start of its first chip, the sound is
    ``Re(envelope(τ) exp(2πi carrier_hz τ))``.

    Attributes
    ----------
    envelope : complex128, shape (n,)
        Sample i stands at ``τ = start_s + i / rate_hz``; smooth enough for cubic interpolation; 0 outside.
    signature : complex128, shape (n,)
        The same without the part that all chips share (the mean of an on-off code): what a search correlates with.
    rate_hz, start_s, carrier_hz : float
    duration_s : float
        Nominal length of the code; the burst's middle is at ``duration_s / 2``.
    """

    envelope: NDArray[np.complex128]
    signature: NDArray[np.complex128]
    rate_hz: float
    start_s: float
    carrier_hz: float
    duration_s: float


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceBurst:
    """A recorded burst (the first seed's calibration): ``samples`` float64 (n,), full scale ±1."""

    samples: Floats
    rate_hz: float


@dataclass(frozen=True, slots=True, eq=False)
class RangeRows:
    """Ranges that a recording states instead of samples; ``sd_m`` holds NaN where a row states none.

    ``speed_sd_mps``: deviation of the site's sound speed, where it made ranges of times of flight; else 0.
    """

    time_s: Floats
    emitter: tuple[str, ...]
    receiver: tuple[str, ...]
    range_m: Floats
    sd_m: Floats | None
    speed_sd_mps: float = 0.0

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Emitter and receiver of each row."""
        return tuple(zip(self.emitter, self.receiver, strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """One of the recording's sensor files: named columns of equal length, NaN where a cell is empty.

    ``vehicle`` (or ``from``/``to`` in ``names``) are text columns; all others are float64 arrays.
    """

    columns: Mapping[str, Floats]
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """One run of a system: what stands where, and samples or ranges.

    Attributes
    ----------
    site : Site
    rate_hz : float or None
        Sample rate; None where the recording has no samples.
    sample_count : int or None
        As the file's header states; the blocks may hold fewer (a cut-off file), never more.
    blocks : callable or None
        ``blocks(n)`` iterates over float32 arrays of shape (≤ n, channels), full scale ±1, from sample 0 on.
    sync_s : float64 (epochs,) or None
        When each sync command arrived; None: epochs start at sample 0 and every period.
    ranges : RangeRows or None
    tables : mapping from file stem ("odometry", "steps", "compass", "imu", "temperature", "start", "bearings",
        "exchanges", "positions") to Table
    references : mapping from beacon id to ReferenceBurst
        Recorded bursts that the site's codes name.
    """

    site: Site
    rate_hz: float | None = None
    sample_count: int | None = None
    blocks: Callable[[int], Iterator[NDArray[np.float32]]] | None = None
    sync_s: Floats | None = None
    ranges: RangeRows | None = None
    tables: Mapping[str, Table] = field(default_factory=dict)
    references: Mapping[str, ReferenceBurst] = field(default_factory=dict)

    @property
    def by_positions(self) -> bool:
        """Whether it holds nothing but positions that others computed to make a track of."""
        ranged = self.blocks is not None or self.ranges is not None or "exchanges" in self.tables
        return not ranged and "positions" in self.tables


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The true poses of one vehicle's origin: ``position_m`` (n, 3); angles (n,), yaw unwrapped; None where unknown."""

    vehicle: str
    time_s: Floats
    position_m: Floats
    yaw_rad: Floats | None
    roll_rad: Floats | None = None
    pitch_rad: Floats | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where a burst is expected: the last estimate seen from one emitter–receiver pair (warm search).

    ``arrival_s`` is the moment the middle of the burst is heard, recorder's clock; ``range_rate_mps`` the
    derivative of the heard range, positive when receding.
    """

    emitter: str
    receiver: str
    arrival_s: float
    arrival_sd_s: float
    range_rate_mps: float
    range_rate_sd_mps: float


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """One way the sound took: delay after the reported arrival (negative: before it) and strength relative to it."""

    delay_s: float
    gain_db: float


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """One burst heard by one microphone.

    Attributes
    ----------
    emitter, receiver : str
    arrival_s : float
        When the microphone's samples hold the middle of the burst, recorder's clock.
    time_scale : float
        dτ/dt of the burst's time τ against the recorder's time: 1 − range rate / c. Above 1 when approaching.
    covariance : float64 (2, 2)
        Of (arrival_s, time_scale), from the curvature of the likelihood and the measured noise.
    amplitude : float
        Of the burst's envelope at the microphone, in full scales per unit of the replica's envelope.
    snr_db : float
        Mean burst power over the noise power in the search band.
    paths : tuple of Path
    sent_before_s : float
        By how much its epoch began before the one it was heard in: above 0 where epochs are shorter than the flight.
    """

    emitter: str
    receiver: str
    arrival_s: float
    time_scale: float
    covariance: Floats
    amplitude: float
    snr_db: float
    paths: tuple[Path, ...] = ()
    sent_before_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Acquisition:
    """All that was heard in one epoch. ``flags`` say in plain words what was odd about its samples."""

    index: int
    sync_s: float
    detections: tuple[Detection, ...]
    flags: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Exchange:
    """Two robots that heard each other: a burst, and the other's own, each robot's times on its own clock.

    Which of both bursts came first does not matter, nor how long one waited for the other.

    Attributes
    ----------
    emitter, receiver : str
        Beacon of the first burst, and the microphone that heard it, on the other robot.
    sent_s, reply_heard_s : float
        On the first robot's clock: when the middle of its burst left, and the other's was heard.
    heard_s, reply_sent_s : float
        On the other's.
    heard_sd_s, reply_heard_sd_s : float or None
        Deviations of what was heard; None: not stated.
    time_scales : (float, float), (float, float) or None
        Of both bursts, as in `Detection`, each with its deviation; None where nobody measured them.
    snr_db : (float, float) or None
    """

    emitter: str
    receiver: str
    sent_s: float
    heard_s: float
    reply_sent_s: float
    reply_heard_s: float
    heard_sd_s: float | None = None
    reply_heard_sd_s: float | None = None
    time_scales: tuple[tuple[float, float], tuple[float, float]] | None = None
    snr_db: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RangeEpoch:
    """Ranges of one epoch, a row an emitter–receiver pair.

    One instant defines a row: ``time_s`` = t is when the receiver hears the middle of the burst and
    ``range_m`` = ``|p_receiver(t) − p_emitter(t − range / c)|`` (plus ``clock_offset`` where ``clock`` is "common").

    Attributes
    ----------
    index : int
    sync_s : float
        When the epoch began, recorder's clock.
    emitter, receiver : tuple of str, length n
    time_s, range_m : float64 (n,)
    covariance_m2 : float64 (n, n)
        Of ``range_m``, full: rows may share noise.
    range_rate_mps, range_rate_sd_mps, snr_db : float64 (n,) or None
        Derivative of ``range_m`` in t, positive when receding.
    clock : "known" or "common"
        "common": all rows share one unknown offset ``clock_offset_m``; true range = range_m − clock_offset_m.
    sound_speed_mps : float
        The speed that made ranges of the delays.
    flags : tuple of str
    sound_speed_sd_mps : float
        Its deviation, which ``covariance_m2`` holds as what all ranges share; 0: taken as it is.
    sd_stated : bool
        False where nobody stated how good ranges are, so that ``covariance_m2`` holds an assumption.
    bias_sd_m : float64 (n,) or None
        Deviation of what the site file states that each pair's ranges err by, which ``covariance_m2`` holds: one error
        of a pair for all epochs; None: no pair has any.
    """

    index: int
    sync_s: float
    emitter: tuple[str, ...]
    receiver: tuple[str, ...]
    time_s: Floats
    range_m: Floats
    covariance_m2: Floats
    range_rate_mps: Floats | None
    range_rate_sd_mps: Floats | None
    snr_db: Floats | None
    clock: Literal["known", "common"]
    sound_speed_mps: float
    flags: tuple[str, ...] = ()
    sound_speed_sd_mps: float = 0.0
    sd_stated: bool = True
    bias_sd_m: Floats | None = None

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.emitter)

    @property
    def bias_m2(self) -> Floats:
        """Variance (n,) of the errors that stay with the rows' pairs."""
        return np.zeros(len(self)) if self.bias_sd_m is None else self.bias_sd_m**2


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """Position of one vehicle from one epoch's ranges alone.

    Attributes
    ----------
    time_s : float
        The instant the state belongs to (the mean of the moments its rows speak of).
    vehicle : str
    status : "ok" or why not; ``remedy`` says in one sentence what would help
    states : tuple of str
        Names of the rows of ``covariance``, among x, y, z, yaw, clock, vx, vy, vz and, of a body that tilts, roll,
        pitch and the rates of the three angles.
    position_m : float64 (3,) or None
        Of the vehicle's origin; None unless the status is "ok" or "inconsistent".
    velocity_mps : float64 (3,) or None
    yaw_rad, clock_offset_m : float or None
    covariance : float64 (k, k) or None
        In m, rad, m and m/s, rows as ``states``.
    hdop, vdop : float or None
        Of unit range variances; vdop is None where the level is known.
    hpl_m, vpl_m : float or None
        Protection levels; None where integrity cannot be judged.
    used : bool (n,)
        For each row of the RangeEpoch whether the position rests on it.
    residual_m : float64 (n,)
        Measured less computed range; NaN where no position was found.
    mirror_m : float64 (3,) or None
        The other solution where geometry leaves two.
    sound_speed_mps, sound_speed_sd_mps : float or None
        What the ranges say of the sound speed, with the epoch's own as the prior; None where that is taken as it is.
    roll_rad, pitch_rad : float or None
        Of a body that tilts (`attitude`); None where it is taken to stand upright.
    """

    time_s: float
    vehicle: str
    status: FixStatus
    remedy: str
    states: tuple[str, ...]
    position_m: Floats | None
    velocity_mps: Floats | None
    yaw_rad: float | None
    clock_offset_m: float | None
    covariance: Floats | None
    hdop: float | None
    vdop: float | None
    hpl_m: float | None
    vpl_m: float | None
    used: NDArray[np.bool_]
    residual_m: Floats
    mirror_m: Floats | None = None
    sound_speed_mps: float | None = None
    sound_speed_sd_mps: float | None = None
    roll_rad: float | None = None
    pitch_rad: float | None = None

    def sd(self, state: str) -> float | None:
        """Return the standard deviation of a state by name, None where it is not estimated."""
        if self.covariance is None or state not in self.states:
            return None
        i = self.states.index(state)
        return float(np.sqrt(self.covariance[i, i]))


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The track of one vehicle at one instant: what its filter believes.

    ``states`` names the rows of ``covariance`` (x, y, z, yaw, clock, vx, vy, vz, roll, pitch as estimated); the pose is
    that of the vehicle's origin, roll and pitch None where it is taken to stand upright. ``source``: "fix" or "fused"
    where a measurement entered, "predicted" where none did, "smoothed" where what came later did too.
    """

    time_s: float
    vehicle: str
    states: tuple[str, ...]
    position_m: Floats
    velocity_mps: Floats
    yaw_rad: float | None
    clock_offset_m: float | None
    covariance: Floats
    source: Source
    roll_rad: float | None = None
    pitch_rad: float | None = None

    def sd(self, state: str) -> float | None:
        """Return the standard deviation of a state by name, None where it is not estimated."""
        if state not in self.states:
            return None
        i = self.states.index(state)
        return float(np.sqrt(self.covariance[i, i]))


@dataclass(frozen=True, slots=True, eq=False)
class Event:
    """Something a user should know of: ``event`` is one word (lost, excluded, reset, gap, …), ``detail`` a sentence."""

    time_s: float
    vehicle: str
    event: str
    detail: str


@dataclass(frozen=True, slots=True)
class Innovation:
    """How far measurements that entered a track at once lay from what was expected of them.

    Attributes
    ----------
    time_s : float
        The instant that the track was corrected for.
    rows : int
        Measurements: ranges and range rates, or coordinates.
    nis : float
        Normalised innovation squared, yᵀ S⁻¹ y: χ² of as many degrees where all covariances are right (Bar-Shalom, Li
        and Kirubarajan 2001, section 5.4).
    """

    time_s: float
    rows: int
    nis: float


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """What one epoch brought: the row of the street from ranges to estimates.

    ``exchanges``: what robots on clocks of their own heard of each other, where ranges come from that.
    ``innovations``: what entered the track, and how far from where it was expected.
    """

    ranges: RangeEpoch
    fixes: tuple[Fix, ...]
    estimates: tuple[Estimate, ...]
    events: tuple[Event, ...]
    range_used: NDArray[np.bool_]
    range_clock_offset_m: Floats
    exchanges: tuple[Exchange, ...] = ()
    innovations: tuple[Innovation, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Pace:
    """How a beacon keeps time: its bursts against the schedule that it should follow.

    With a sync command the schedule is those commands; else it is the nominal period. ``rate`` and ``drift_per_s`` are
    fitted to ``late_s`` as a straight line or, where that is significant, a parabola; both are stated for the middle.

    Attributes
    ----------
    scheduled_s : float64 (n,)
        When each burst was due, in order, up to a constant where nothing synchronises.
    late_s : float64 (n,)
        Measured less due, less its mean.
    residual_s : float64 (n,)
        What the fit leaves.
    used : bool (n,)
        Whether the burst entered fit and average.
    rate, rate_sd : float
        Relative excess of the period: positive when bursts come ever later.
    drift_per_s, drift_sd_per_s : float or None
        Change of ``rate`` a second; None where a straight line does.
    jitter_s : float
        Root mean square of the residuals of used bursts.
    allan_tau_s, allan : float64 (m,)
        Allan deviation of the relative period (IEEE 1139) at spans of 1, 2, 4, … bursts.
    """

    scheduled_s: Floats
    late_s: Floats
    residual_s: Floats
    used: NDArray[np.bool_]
    rate: float
    rate_sd: float
    drift_per_s: float | None
    drift_sd_per_s: float | None
    jitter_s: float
    allan_tau_s: Floats
    allan: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A beacon's burst as one microphone heard it at rest, learnt from many.

    Attributes
    ----------
    beacon, microphone : str
    burst : ReferenceBurst
        One burst, of peak 0.9. It was sent ``start_s`` after the first sample and stands there as if heard from
        ``flight_m``: next to nothing, since a flight inside would carry the calibration's air to every later day.
    start_s, flight_m : float
    waveform : Waveform
        What a receiver makes of ``burst``.
    nominal : Waveform or None
        What the site file says of the burst; None where its code is not known.
    heard : int
        Bursts found.
    left_out : mapping from reason to count
        Bursts that did not enter the average.
    amplitude, amplitude_sd : float
        Peak of the envelope at the microphone, full scale 1, and its deviation from burst to burst.
    snr_db, snr_gain_db : float
        Mean burst power over the noise in ``band_hz`` for one burst, and what averaging added.
    band_hz : (float, float)
        What was listened to.
    match : float or None
        Correlation of the learnt with the nominal envelope: 1 where only delay, strength and phase differ.
    stretch, stretch_sd : float or None
        Relative excess of the carrier over the nominal, as a clock or a motion makes it.
    delay_s : float or None
        How much later than commanded the sound leaves the beacon; None where no command or no distance is known.
    delay_sd_s : float or None
        By noise and jitter alone.
    delay_total_sd_s : float or None
        With the doubts about distance and sound speed, which all bursts share.
    distance_m, distance_sd_m, sound_speed_mps : float
        What the delay rests on; the distance is None where it is not known.
    period_s : float
        Nominal.
    pace : Pace
    response_s, response : float64 (r,), complex128 (r,) or None
        What one chip (or an impulse of a chirp) sounds like, its time from the chip's start; None where the code is
        not known.
    gate_s : float or None
        Until when the response entered ``burst``; None where the plain average did.
    echoes : tuple of Path
        Later than the gate, strongest first.
    residual_s, residual_rms, noise_rms : float64 (m,), (m,), float
        Root mean square of what single bursts leave beside the average, over burst time; and that before the burst.
    flags : tuple of str
    """

    beacon: str
    microphone: str
    burst: ReferenceBurst
    start_s: float
    flight_m: float
    waveform: Waveform
    nominal: Waveform | None
    heard: int
    left_out: Mapping[str, int]
    amplitude: float
    amplitude_sd: float
    snr_db: float
    snr_gain_db: float
    band_hz: tuple[float, float]
    match: float | None
    stretch: float | None
    stretch_sd: float | None
    delay_s: float | None
    delay_sd_s: float | None
    delay_total_sd_s: float | None
    distance_m: float | None
    distance_sd_m: float
    sound_speed_mps: float
    period_s: float
    pace: Pace
    response_s: Floats | None
    response: NDArray[np.complex128] | None
    gate_s: float | None
    echoes: tuple[Path, ...]
    residual_s: Floats
    residual_rms: Floats
    noise_rms: float
    flags: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class PathInsight:
    """One way of one burst, as it stands in the receiver's final model, or as it was when it was dropped.

    Attributes
    ----------
    range_m, range_sd_m : float
        As in `RangeEpoch`, by its own noise alone; the deviation is None for what was dropped.
    range_rate_mps, range_rate_sd_mps : float
        Positive when receding.
    level_db : float
        Correlation power over the noise around it.
    amplitude : float
        Of the envelope at the microphone, full scale 1.
    is_range : bool
        Whether it is the one reported: the first path of weight.
    dropped : str
        Why it was dropped; empty for what was kept.
    """

    range_m: float
    range_sd_m: float | None
    range_rate_mps: float
    range_rate_sd_mps: float | None
    level_db: float
    amplitude: float
    is_range: bool
    dropped: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class BeaconInsight:
    """What the search for one beacon saw in one epoch.

    Attributes
    ----------
    beacon : str
    range_m : float64 (d,)
        Ways that the delays stand for, ascending: those of the whole window.
    range_rate_mps : float64 (m,)
        Of the replicas, ascending.
    heard_db, alone_db : float32 (m, d)
        Correlation power over the noise: in the samples as they came, and when tones, clicks and all other beacons'
        bursts are taken away.
    threshold_db : float
        What a lone peak must exceed over the noise.
    predicted : (low, high) of the way in m, (low, high) of the range rate in m/s, or None
        Where the search was warm: what it looked through.
    paths : tuple of PathInsight
        Kept and dropped, by way.
    verdict : str
        Why no range is reported; empty where one is.
    """

    beacon: str
    range_m: Floats
    range_rate_mps: Floats
    heard_db: NDArray[np.float32]
    alone_db: NDArray[np.float32]
    threshold_db: float
    predicted: tuple[tuple[float, float], tuple[float, float]] | None
    paths: tuple[PathInsight, ...]
    verdict: str

    @property
    def reported(self) -> PathInsight | None:
        """The path that is the range."""
        return next((path for path in self.paths if path.is_range), None)


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """One stage of taking an epoch apart: what was done, to which beacons' bursts, and what was left.

    ``left_db`` is the power left while bursts sound, over that of the quiet margins.
    """

    deed: str
    beacons: tuple[str, ...]
    left_db: float


@dataclass(frozen=True, slots=True, eq=False)
class BandInsight:
    """One slice of the spectrum, in which the beacons of one carrier were looked for.

    Attributes
    ----------
    carrier_hz : float
    edges_hz : (float, float)
        Of the pass band.
    frequency_hz : float64 (k,)
        Ascending, within the edges.
    heard_db, clean_db, left_db : float64 (k,)
        Power density, dB of full scale² per Hz: as heard, when tones and clicks are taken out, and when all bursts are.
    quiet_db : float or None
        That of the quieter of the two margins, if it were white over the band; None where they are silence itself.
    tones_hz : tuple of float
        Steady tones that were taken out.
    time_s : float64 (n,)
        Recorder's clock.
    heard_power_db, left_power_db : float64 (n,)
        Power by time, smoothed over 1 ms, over that of the quiet margins: as heard, and when all is taken out.
    aside : bool (n,)
        Set aside as clicks or drop-outs.
    stages : tuple of Stage
    beacons : tuple of BeaconInsight
    """

    carrier_hz: float
    edges_hz: tuple[float, float]
    frequency_hz: Floats
    heard_db: Floats
    clean_db: Floats
    left_db: Floats
    quiet_db: float | None
    tones_hz: tuple[float, ...]
    time_s: Floats
    heard_power_db: Floats
    left_power_db: Floats
    aside: NDArray[np.bool_]
    stages: tuple[Stage, ...]
    beacons: tuple[BeaconInsight, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Insight:
    """One epoch of one microphone as the receiver saw it, from the spectrum to the paths.

    Attributes
    ----------
    epoch : int
        Steps before this one in the run.
    sync_s : float
        When the epoch began, recorder's clock.
    microphone : str
    search : str
        "warm" round predictions from the track, or "cold" and why.
    sound_speed_mps : float
    clock : "known" or "common"
        "common": all ways share one unknown offset.
    frequency_hz, spectrum_db : float64 (k,)
        Of the samples as recorded: power density, dB of full scale² per Hz.
    bands : tuple of BandInsight
    detections : tuple of Detection
        What the epoch reported; strongest first.
    notes : tuple of str
        What was odd about the samples, and what was done to them.
    used : mapping from beacon id to bool
        For each range reported whether the run used it.
    events : tuple of Event
        Of that step of the run.
    """

    epoch: int
    sync_s: float
    microphone: str
    search: str
    sound_speed_mps: float
    clock: Literal["known", "common"]
    frequency_hz: Floats
    spectrum_db: Floats
    bands: tuple[BandInsight, ...]
    detections: tuple[Detection, ...]
    notes: tuple[str, ...]
    used: Mapping[str, bool]
    events: tuple[Event, ...]

    def left_out(self, beacons: Iterable[BeaconInsight]) -> list[str]:
        """Say what was excluded and why, a reason a line: samples, ranges and paths of some of the beacons."""
        shown = list(beacons)
        lines = [f"Samples: {note}." for note in self.notes]
        lines += [f"{b.beacon}: no range; {b.verdict}." for b in shown if b.verdict]
        unused = [b.beacon for b in shown if b.reported is not None and not self.used.get(b.beacon, True)]
        if unused:
            lines.append(f"{', '.join(unused)}: ranged, but believed by no fix nor track.")
        lines += [f"Run: {event.event}; {event.detail}." for event in self.events if event.event != "samples"]
        why = Counter("no higher" in p.dropped for b in shown for p in b.paths if p.dropped)
        for alike, reason in ((False, "too faint"), (True, "no higher than other peaks of their search")):
            if why[alike]:
                lines.append(f"Paths: {why[alike]} that were tried proved {reason} when all else was taken away.")
        return lines


@dataclass(frozen=True, slots=True, eq=False)
class Walls:
    """Walls and obstacles of a floor plan, seen from above: what sound does not pass.

    Attributes
    ----------
    start_m, end_m : float64 (k, 2)
        Ends of each straight piece.
    height_m : float64 (k,)
        Its top; infinite where it reaches the ceiling. All stand on the floor.
    solid : int64 (k,)
        Number of the obstacle whose outline (or hole) the piece belongs to; −1: a wall on its own.
    """

    start_m: Floats
    end_m: Floats
    height_m: Floats
    solid: NDArray[np.int64]

    def __len__(self) -> int:
        """Return the number of pieces."""
        return len(self.height_m)

    @classmethod
    def none(cls) -> Walls:
        """Return a floor plan without walls."""
        return cls(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """What a layout promises at each place of a level; grids are indexed ``[j, i]`` for ``(x_m[i], y_m[j])``.

    Attributes
    ----------
    x_m, y_m : float64 (nx,), (ny,)
    level_m : float
        Height of the map: that of what listens (or of what sounds, where the vehicle does).
    floor : bool (ny, nx)
        Whether one can be there: not inside an obstacle. Elsewhere all else is 0 or NaN.
    heard : int64 (ny, nx)
        Beacons heard (fixed microphones that hear, where the vehicle sounds).
    hdop, vdop : float64 (ny, nx)
        Of unit range deviations; NaN where there is no fix. ``vdop`` is None where the level is known.
    sd_m, sd_z_m : float64 (ny, nx)
        Expected deviation of the position, √(σx² + σy²), and of the height; NaN and None likewise.
    fault_m : float64 (ny, nx)
        Smallest fault of one range that is detected whichever range it is in, by the linear model (ranges taken as
        straight near the place); infinite where none is detected, NaN where there is no fix.
    """

    x_m: Floats
    y_m: Floats
    level_m: float
    floor: NDArray[np.bool_]
    heard: NDArray[np.int64]
    hdop: Floats
    vdop: Floats | None
    sd_m: Floats
    sd_z_m: Floats | None
    fault_m: Floats

    @property
    def fix(self) -> NDArray[np.bool_]:
        """Places with a fix (ny, nx)."""
        return np.isfinite(self.sd_m)

    def share(self, where: NDArray[np.bool_]) -> float:
        """Share of the floor where something holds, 0 … 1."""
        return float(np.mean(where[self.floor])) if self.floor.any() else 0.0

    def over_floor(self, values: Floats, percent: float) -> float:
        """Percentile over the whole floor; places without a value count as infinite."""
        known = np.where(np.isfinite(values), values, np.inf)[self.floor]
        return float(np.percentile(known, percent, method="higher")) if known.size else float("inf")


@dataclass(frozen=True, slots=True, eq=False)
class SurveyedBeacon:
    """One fixed beacon before and after a survey.

    Attributes
    ----------
    id : str
    before_m, position_m : float64 (3,)
        As the site file has it, and as found.
    before_sd_m : float or None
        Of the guess, per axis; 0: known, and not moved; None: the guess was not looked at.
    covariance_m2 : float64 (3, 3)
        Of the place found within the survey's frame (`Survey.gauge`); zero where it is known.
    bias_m, bias_sd_m : float or None
        How much longer its ranges are than the ways, by a delay that the site file does not state; None where each
        pair has its own, or none was sought.
    heard, used : int
        Rows.
    residual_m : float
        Root mean square of its used ranges' residuals; NaN where there are none.
    mirrored : bool
        Whether its image on the other side of the microphones' level fits alike.
    """

    id: str
    before_m: Floats
    position_m: Floats
    before_sd_m: float | None
    covariance_m2: Floats
    bias_m: float | None
    bias_sd_m: float | None
    heard: int
    used: int
    residual_m: float
    mirrored: bool = False

    @property
    def sd_m(self) -> Floats:
        """Deviations (3,) along the axes."""
        return np.sqrt(np.diag(self.covariance_m2))


@dataclass(frozen=True, slots=True, eq=False)
class OpenDirection:
    """A direction, of one beacon or of several together, that a drive does not tell.

    ``move_m`` (beacons, 3): how the beacons move along it, of root sum square 1, in the order of `Survey.beacons`;
    ``drive_sd_m``: what the drive alone leaves of it, infinite where it says nothing; ``sd_m``: with what was known
    before; ``text`` says it in plain words.
    """

    move_m: Floats
    drive_sd_m: float
    sd_m: float
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class PairBias:
    """How much longer the ranges of an emitter–receiver pair are than their ways; ``emitter`` is empty for any."""

    emitter: str
    receiver: str
    bias_m: float
    sd_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """Where beacons are, by a drive.

    Attributes
    ----------
    status : "ok", "open" (some directions stay unknown) or "failed"; ``remedy`` says in one sentence what would help
    beacons : tuple of SurveyedBeacon
        The fixed ones, as the site file orders them.
    covariance_m2 : float64 (3 B, 3 B)
        Of all their places jointly, within the frame that ``gauge`` describes.
    gauge : str
        What the frame rests on.
    frame_sd : mapping from x_m, y_m, z_m, roll_rad, pitch_rad, yaw_rad to float
        How well the frame of guesses is known, for what no data tell; empty where known beacons hold the frame.
    mirror : str
        What is undecided between mirror images; empty where nothing is.
    open : tuple of OpenDirection
        Weakest first.
    pairs : tuple of PairBias
        Where each pair has its own bias; else those of fixed microphones.
    sound_speed_mps, sound_speed_sd_mps : float
    sound_speed_prior_mps, sound_speed_prior_sd_mps : float
        What it began with, a deviation of 0: taken as stated.
    clock_offset_m, clock_drift_mps : float or None
        Of an unknown common clock, at the recording's time 0.
    drive : mapping from vehicle to float64 (n, 4)
        Time and place of each epoch, where its motion is followed.
    rows, excluded : int
    before_m, after_m, rate_after_mps : float
        Root mean squares of residuals: of ranges as the site file would have them (vehicles solved for), of used ranges
        and of used range rates (NaN where there are none).
    inflation : float
        Factor on all deviations, since residuals are larger than stated ones; 1 where they are not.
    events : tuple of Event
    """

    status: Literal["ok", "open", "failed"]
    remedy: str
    beacons: tuple[SurveyedBeacon, ...]
    covariance_m2: Floats
    gauge: str
    frame_sd: Mapping[str, float]
    mirror: str
    open: tuple[OpenDirection, ...]
    pairs: tuple[PairBias, ...]
    sound_speed_mps: float
    sound_speed_sd_mps: float
    sound_speed_prior_mps: float
    sound_speed_prior_sd_mps: float
    clock_offset_m: float | None
    clock_drift_mps: float | None
    drive: Mapping[str, Floats]
    rows: int
    excluded: int
    before_m: float
    after_m: float
    rate_after_mps: float
    inflation: float
    events: tuple[Event, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A line or a cloud of points in a study's panel; NaN in ``y`` breaks it.

    ``kind`` says what it shows: "truth", "raw" (single measurements), "alone" (what one sensor does without help),
    "result" (what an estimator makes of all), "bound" (a claim, a limit) or "points" (cases apart, not joined).
    """

    name: str
    x: Floats
    y: Floats
    kind: Literal["truth", "raw", "alone", "result", "bound", "points"]


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One diagram of a study; ``note`` stands beside its title.

    ``y_limits`` None: as the curves need; ``blind``: spans of x in which beacons were silent.
    """

    title: str
    note: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    y_limits: tuple[float, float] | None = None
    logarithmic: bool = False
    blind: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """One figure that a study found.

    Attributes
    ----------
    case, quantity : str
        What was run, and what was measured on it.
    value : float
    sd : float or None
        Its standard error over the runs; None where one run tells none.
    unit : "m", "m/s" or "" (a share)
    runs : int
    claim : str
        What the seed says of it, or what it should be; empty where neither.
    """

    case: str
    quantity: str
    value: float
    sd: float | None
    unit: str
    runs: int
    claim: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Listing:
    """A table of a study, of one run: ``name`` is its file's, ``columns`` carry units, a row a step."""

    name: str
    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str | int | float, ...], ...]


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """What a study shows: ``panels`` row by row, so many ``columns``, the figures found, and tables."""

    title: str
    note: str
    columns: int
    panels: tuple[Panel, ...]
    findings: tuple[Finding, ...]
    listings: tuple[Listing, ...] = ()
