"""Before anything is drilled: what a layout of beacons promises at each place of the floor.

A place is judged by the ranges of the beacons it would hear: those in the link budget's reach (`budget`) and in sight
across the floor plan (`walls`). What they tell of the position is `judge`'s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sonofix.acquire.epochs import reach_s
from sonofix.channel.simulate import absorption_of
from sonofix.locate.integrity import noncentrality
from sonofix.plan.budget import Budget, Link, links_of, strength
from sonofix.plan.coverage import coded_or_all, grid
from sonofix.plan.judge import WEAK, Judgement, judged
from sonofix.plan.walls import in_sight, inside
from sonofix.records import Floats, Quality, Walls, Waveform
from sonofix.site import Beacon, Microphone, Site

OnDone = Callable[[float], None]

AT_ONCE = 2048
"""Places judged between two reports of progress."""

MOST_DEGREES = 64
"""Beyond so many ranges to spare, a fault that is detected hardly changes with one more."""


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """The fixed ends of ranges: beacons, or microphones where the vehicle sounds.

    Attributes
    ----------
    ids : tuple of str
    position_m : float64 (b, 3)
    misplaced_m : float64 (b,)
        Deviation of each stated place, along any way.
    links : tuple of Link or None
        What is heard from each; None where ranges have a stated deviation.
    """

    ids: tuple[str, ...]
    position_m: Floats
    misplaced_m: Floats
    links: tuple[Link | None, ...]

    def __len__(self) -> int:
        """Return the number of nodes."""
        return len(self.ids)

    def pick(self, keep: Sequence[int]) -> Nodes:
        """Return some of the nodes, in the order asked for."""
        rows = np.array(keep, np.int64)
        links = tuple(self.links[i] for i in keep)
        return Nodes(tuple(self.ids[i] for i in keep), self.position_m[rows], self.misplaced_m[rows], links)

    def placed(self, which: Sequence[int]) -> Nodes:
        """Return the nodes, some of them exactly where they are said to be."""
        misplaced = self.misplaced_m.copy()
        misplaced[list(which)] = 0.0
        return Nodes(self.ids, self.position_m, misplaced, self.links)

    def joined(self, other: Nodes) -> Nodes:
        """Return these and others."""
        place = np.concatenate([self.position_m, other.position_m])
        misplaced = np.concatenate([self.misplaced_m, other.misplaced_m])
        return Nodes(self.ids + other.ids, place, misplaced, self.links + other.links)


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """What places are judged by, whatever stands where.

    Attributes
    ----------
    sound_speed_mps, speed_sd : float
        The latter relative: a doubt that all ranges share.
    free_level, clock : bool
        Whether the height, and an offset of all ranges, are unknown.
    budget : Budget or None
        None: every range has ``range_sd_m``.
    range_sd_m : float or None
    reach_m : float or None
        Greatest way over which ranges are had at all, whatever the budget.
    aim_m : (x, y, z) or None
        What fixed transducers with a beam face; None: straight down (up, for those below the map).
    bounds_m : float64 (2, 3) or None
    walls : Walls
    """

    sound_speed_mps: float
    speed_sd: float = 0.0
    free_level: bool = False
    clock: bool = False
    budget: Budget | None = None
    range_sd_m: float | None = None
    reach_m: float | None = None
    aim_m: tuple[float, float, float] | None = None
    bounds_m: Floats | None = None
    walls: Walls = field(default_factory=Walls.none)


def nodes_of(site: Site, budget: Budget | None, waveforms: Mapping[str, Waveform], usual_speed_mps: float) -> Nodes:
    """Return a site's fixed nodes, with their links where there is a budget.

    Parameters
    ----------
    site : Site
    budget : Budget or None
    waveforms : mapping from beacon id to Waveform
        Of the coded beacons.
    usual_speed_mps : float
        Of vehicles that state no ``max_speed_mps``.

    Raises
    ------
    ValueError
        No node is fixed, or there is a budget but nothing sounds.
    """
    nodes = coded_or_all(site)
    position = np.array([node.position_m for node in nodes], float)
    misplaced = np.array([node.position_sd_m if isinstance(node, Beacon) else 0.0 for node in nodes])
    links: list[Link | None] = [None] * len(nodes)
    if budget is not None:
        links = list(_links(site, nodes, budget, waveforms, usual_speed_mps))
    return Nodes(tuple(node.id for node in nodes), position, misplaced, tuple(links))


def _links(
    site: Site,
    nodes: Sequence[Beacon] | Sequence[Microphone],
    budget: Budget,
    waveforms: Mapping[str, Waveform],
    usual_speed_mps: float,
) -> list[Link]:
    sounding = [node.id for node in nodes] if isinstance(nodes[0], Beacon) else [next(iter(waveforms), "")]
    silent = [name for name in sounding if name not in waveforms]
    if silent:
        raise ValueError(
            f"no burst is known of {', '.join(silent) or 'any beacon'}: give each [[beacon]] a code, or state a range's"
            " deviation in place of a link budget"
        )
    bursts = [waveforms[name] for name in sounding]
    speeds = [v.max_speed_mps or usual_speed_mps for v in site.vehicles] or [0.0]
    c, absorption = site.sound_speed_mps, [absorption_of(site, w.carrier_hz) for w in bursts]
    links = links_of(bursts, budget.rate_hz, c, absorption, reach_s(site, c), max(speeds))
    return links if len(links) == len(nodes) else links * len(nodes)


def weights(nodes: Nodes, places_m: Floats, terms: Terms) -> Floats:
    """Return 1/σ² of each range, 1/m², by noise and misplaced beacons; 0 where it is not heard: float64 (p, b)."""
    way = places_m[:, None, :] - nodes.position_m[None, :, :]
    distance = np.sqrt(np.einsum("pbi,pbi->pb", way, way))
    sd = np.full(distance.shape, np.nan if terms.range_sd_m is None else terms.range_sd_m)
    heard = np.ones(distance.shape, bool) if terms.reach_m is None else distance <= terms.reach_m
    if terms.budget is not None:
        cosine = _cosine(nodes, way, distance, terms) if terms.budget.beam_rad is not None else None
        for link in dict.fromkeys(nodes.links):
            same = np.array([other is link or other == link for other in nodes.links])
            if link is None:
                raise ValueError("a node has no link, and there is a budget; make nodes with that budget")
            off_axis = None if cosine is None else cosine[:, same]
            got = strength(link, terms.budget, distance[:, same], terms.sound_speed_mps, off_axis)
            sd[:, same] = got.sd_m
            heard[:, same] &= got.heard
    if len(terms.walls):
        heard &= in_sight(terms.walls, nodes.position_m, places_m)
    return np.where(heard, 1.0 / (sd**2 + nodes.misplaced_m**2), 0.0)


def _cosine(nodes: Nodes, way: Floats, distance: Floats, terms: Terms) -> Floats:
    """Of the angle between each node's axis and each way."""
    if terms.aim_m is None:
        # down for what hangs above
        return np.abs(way[:, :, 2]) / np.maximum(distance, 1e-9)
    axis = np.array(terms.aim_m) - nodes.position_m
    axis /= np.maximum(np.linalg.norm(axis, axis=1), 1e-9)[:, None]
    return np.einsum("pbi,bi->pb", way, axis) / np.maximum(distance, 1e-9)


def detected_shifts(most: int) -> Floats:
    """Root of the noncentrality that the receiver's χ² test detects, by degrees of freedom: float64 (k,)."""
    return np.sqrt([noncentrality(d) if d else np.inf for d in range(min(max(most, 1), MOST_DEGREES) + 1)])


def quality(
    site: Site,
    nodes: Nodes,
    terms: Terms,
    level_m: float,
    spacing_m: float = 0.25,
    margin_m: float = 0.0,
    on_done: OnDone | None = None,
) -> Quality:
    """Map what nodes promise on a level.

    Parameters
    ----------
    site : Site
        Its ``bounds_m`` (or else the box of its fixed nodes) is the area.
    nodes : Nodes
    terms : Terms
    level_m : float
        Height of what listens, or sounds.
    spacing_m, margin_m : float
        Of the grid, and of a strip left out along the edges.
    on_done : callable, optional
        Told the share that is done.

    Raises
    ------
    ValueError
        The grid is impossible: see `coverage.grid`.
    """
    x, y, places, floor = places_of(site, terms.walls, level_m, spacing_m, margin_m)
    heard = np.zeros(len(places), np.int64)
    values = np.full((5, len(places)), np.nan)
    where = np.flatnonzero(floor)
    shift = detected_shifts(len(nodes))
    for start in range(0, len(where), AT_ONCE):
        at = where[start : start + AT_ONCE]
        got = judge(nodes.position_m, weights(nodes, places[at], terms), places[at], terms, shift)
        heard[at] = got.heard
        values[:, at] = got.hdop, got.vdop, got.sd_m, got.sd_z_m, got.fault_m
        if on_done is not None:
            on_done(min(start + AT_ONCE, len(where)) / len(where))
    shape = (len(y), len(x))
    hdop, vdop, sd, sd_z, fault = (row.reshape(shape) for row in values)
    return Quality(
        x_m=x,
        y_m=y,
        level_m=float(level_m),
        floor=floor.reshape(shape),
        heard=heard.reshape(shape),
        hdop=hdop,
        vdop=vdop if terms.free_level else None,
        sd_m=sd,
        sd_z_m=sd_z if terms.free_level else None,
        fault_m=fault,
    )


def places_of(
    site: Site, walls: Walls, level_m: float, spacing_m: float, margin_m: float
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    """Return a map's x (nx,) and y (ny,), its places (ny · nx, 3) row by row, and which of them are floor.

    No obstacle is so low that one could stand in it.
    """
    x, y = grid(site, spacing_m, margin_m)
    places = np.column_stack([np.tile(x, len(y)), np.repeat(y, len(x)), np.full(len(x) * len(y), level_m)])
    ground = places.copy()
    ground[:, 2] = -np.inf
    return x, y, places, ~inside(walls, ground)


def judge(nodes_m: Floats, weight: Floats, places_m: Floats, terms: Terms, shift: Floats | None) -> Judgement:
    """Do `judged` by the terms."""
    return judged(
        places_m,
        nodes_m,
        weight,
        free_level=terms.free_level,
        clock=terms.clock,
        speed_sd=terms.speed_sd,
        mirrors=True,
        bounds_m=terms.bounds_m,
        shift=shift,
        weak=WEAK,
    )
