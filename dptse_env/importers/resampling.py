"""Resampling of points at any times to a row for each vehicle and whole second."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np
import polars as pl

from dptse_env.importers.placing import Branches
from dptse_env.importers.source import Source, TrajectoryError
from dptse_env.importers.units import Motion, check_units
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.units import HOUR
from dptse_env.utils.validation import shown

TIME_UNIT = 1e-4
"""Times are rounded to this [s]: sums of frame lengths are not whole in floating point."""
FASTEST_MOVE = 300.0 / HOUR
"""Distance a second that no vehicle exceeds [km/s]; more is a jump to another place."""
JUMP = 0.05
"""Distance that noise may add, forwards or backwards [km]."""
SAME_PLACE = 0.005
"""Largest distance between two points that count as duplicates [km]."""
FEWEST_TOGETHER = 3
"""Vehicles that drive on at an earlier time, together, if a clock was set back."""
MOST_SHARING = 20
"""Vehicles that may share an id at one time."""
HALF_WIDTH = 0.5
"""A derived speed is the mean over this time [s] on both sides."""


def whole_seconds(
    points: pl.DataFrame, branches: Branches, longest_gap: float, counts: Counter[str], where: str
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return vehicles at whole seconds, and a row for each piece of a trajectory.

    Args:
        points: All points on the road of some vehicles: row, id (whole numbers), vehicle (the
            file's name for it), time [s], position [km], speed [km/h] (null to derive it), branch,
            column, lane_number, group.
        branches: Those of the road that they are on.
        longest_gap: Longest time without points that is filled by interpolation [s].
        counts: What happens is added to it.
        where: The file, for messages.

    Raises:
        TrajectoryError: Many vehicles share an id at one time.
    """
    points = _in_order(points, longest_gap, counts, where)
    c, following = pl.col, pl.all().shift(-1)
    same = (c("id") == c("next_id")).fill_null(False)
    wait, move = c("next_time") - c("time"), c("next_position") - c("position")
    points = (
        points.with_columns(following.name.prefix("next_"))
        .with_columns(same=same & (c("track") == c("next_track")), wait=wait, move=move)
        .with_columns(paused=c("same") & (c("wait") > longest_gap))
        .with_columns(
            jumped=c("same")
            & ~c("paused")
            & (_too_far(c("move"), c("wait")) | _backwards(c("move")))
        )
        .with_columns(joined=c("same") & ~c("paused") & ~c("jumped"))
        .with_columns(chain=c("joined").not_().cum_sum().shift(1, fill_value=0))
    )
    # The usual time between the points of a vehicle; more is a gap.
    usual = c("wait").filter(c("same")).median()
    on_time = c("time").ceil() == c("time")
    end = pl.when("joined").then(c("next_time").ceil()).otherwise(c("time").ceil() + on_time)
    points = points.with_columns(
        filled=c("joined") & (c("wait") > 1.5 * usual),
        n=(end - c("time").ceil()).cast(pl.Int64),
        piece=c("chain") - c("chain").first().over("id"),
    )
    told = points.select(
        followed=c("same").sum(), gaps_cut=c("paused").sum(), jumps_cut=c("jumped").sum(),
        gaps_filled=c("filled").sum(),
        seconds_filled=(c("n") - on_time).clip(0).filter("filled").sum(),
        vehicles=c("id").n_unique(),
    )  # fmt: skip
    counts.update(told.row(0, named=True))
    share = (c("second") - c("time")) / pl.when("joined").then("wait").otherwise(1.0)
    rows = (
        points.with_row_index("place")
        .filter(c("n") > 0)
        .with_columns(first=c("time").ceil().cast(pl.Int64))
        .with_columns(second=pl.int_ranges("first", c("first") + c("n")))
        .explode("second")
        .with_columns(share=share)
        .with_columns(_between("position"), _between("speed"))
        .with_columns(
            nearer=pl.when(c("share") < 0.5).then("branch").otherwise("next_branch"),
            changed=(c("share") > 0.0) & (c("next_column") != c("column")),
        )
    )
    at = rows.filter("changed").select(c("nearer"), c("position"))
    column = rows["column"].to_numpy().copy()
    column[rows["changed"].to_numpy()] = branches.column(*(each.to_numpy() for each in at))
    speed = rows["speed"].to_numpy()
    if points["speed"].null_count():
        speed = _derived(points, rows["place"].to_numpy(), rows["second"].to_numpy())
    rows = rows.with_columns(column=column, speed=speed).filter(
        c("column") >= 0, c("speed").is_finite()
    )
    counts["negative_speeds"] += rows.filter(c("speed") < 0.0).height
    counts["seconds"] += len(rows)
    rows = rows.with_columns(c("speed").clip(0.0), lane=c("lane_number"))
    wanted = ("id", "piece", "group", "second", "column", "lane", "position", "speed")
    return rows.select(wanted), _pieces(points, counts)


def _too_far(move: pl.Expr, wait: pl.Expr) -> pl.Expr:
    return move > FASTEST_MOVE * wait + JUMP


def _backwards(move: pl.Expr) -> pl.Expr:
    return move < -JUMP


def _between(name: str) -> pl.Expr:
    at, after = pl.col(name), pl.col(f"next_{name}")
    return pl.when(pl.col("share") > 0.0).then(at + pl.col("share") * (after - at)).otherwise(at)


def _in_order(
    points: pl.DataFrame, longest_gap: float, counts: Counter[str], where: str
) -> pl.DataFrame:
    """Return points by vehicle and time without duplicates, with the track of each.

    A vehicle that is in two places at once is several vehicles that share an id: each is a track.
    """
    c = pl.col
    late = points.select((c("time").diff().over("id") < 0.0).sum()).item()
    counts["out_of_order"] += late
    points = points.sort("id", "time", "row")
    again = (c("id").diff() == 0) & (c("time").diff() == 0.0)
    near = (c("position").diff().abs() <= SAME_PLACE) & (c("lane_number").diff() == 0)
    points = points.with_columns(twice=again.fill_null(False), near=near, track=pl.lit(0))
    counts["duplicates"] += points.filter("twice", "near").height
    points = points.filter((c("twice") & c("near")).not_())
    # Positions that jump there and back are those of vehicles whose times alternate.
    same, wait, move = c("id").diff() == 0, c("time").diff(), c("position").diff()
    soon = same & (wait <= longest_gap)
    points = points.with_columns(
        there=(soon & _too_far(move, wait)).fill_null(False),
        back=(soon & _backwards(move)).fill_null(False),
    )
    shared = points.group_by("id", maintain_order=True).agg(
        c("twice").any(), jumps=pl.min_horizontal(c("there").sum(), c("back").sum())
    )
    ambiguous = shared.filter(c("twice") | (c("jumps") > 1))["id"]
    if len(ambiguous):
        kept = points.filter(c("id").is_in(ambiguous.implode()).not_())
        several = points.filter(c("id").is_in(ambiguous.implode()))
        vehicles = several.partition_by("id", maintain_order=True)
        tracks = [_tracks(each, longest_gap, where) for each in vehicles]
        counts["ids_shared"] += len(tracks)
        counts["duplicates"] += sum(int((each < 0).sum()) for each in tracks)
        several = several.with_columns(track=pl.Series(np.concatenate(tracks), dtype=pl.Int32))
        points = pl.concat([kept, several.filter(c("track") >= 0)], how="vertical_relaxed")
        points = points.sort("id", "track", "time")
    return points.drop("twice", "near", "there", "back", "vehicle")


def _tracks(points: pl.DataFrame, longest_gap: float, where: str) -> IntArray:
    """Return which of the vehicles that share an id each point belongs to; -1 for a duplicate.

    Points are taken in order of time. Each goes on with the track that would be nearest at its
    speed, one in its lane rather, if it can be reached, and begins another one otherwise.
    """
    # Time, position, lane and speed at the end of each track that may go on.
    ends: dict[int, tuple[float, float, int, float]] = {}
    found: IntArray = np.empty(len(points), dtype=np.int64)
    n = 0
    rows = points.select("time", "position", "lane_number").iter_rows()
    for i, (time, position, lane) in enumerate(rows):
        best, nearest = n, np.inf
        for number, (t, p, on, v) in list(ends.items()):
            wait, move = time - t, position - p
            if wait > longest_gap:
                del ends[number]
                continue
            if wait == 0.0 and abs(move) <= SAME_PLACE and lane == on:
                best = -1
                break
            away = abs(move - v * wait) + SAME_PLACE * (lane != on)
            if wait > 0.0 and -JUMP <= move <= FASTEST_MOVE * wait + JUMP and away < nearest:
                best, nearest = number, away
        found[i] = best
        if best == n:
            ends[n] = time, position, lane, 0.0
            n += 1
            if len(ends) > MOST_SHARING:
                raise TrajectoryError(
                    f"{where}, row {points['row'][i]}: an id must be that of a vehicle, got "
                    f"{shown(points['vehicle'][i])} at over {MOST_SHARING} places within "
                    f"{longest_gap:g} s: is the column of the vehicle right?"
                )
        elif best >= 0:
            t, p, _, _ = ends[best]
            ends[best] = time, position, lane, (position - p) / (time - t)
    return found


def stretches(points: pl.DataFrame, longest_gap: float) -> pl.DataFrame:
    """Return the stretches of a vehicle's points that go on in time, in the order of the file.

    Args:
        points: Points of some vehicles, as for `whole_seconds`.
        longest_gap: Longest time between two points of a stretch [s].

    Returns:
        Group, first and last row, begin and end [s] and number of points of each; none where points
        are mostly in no order.
    """
    c = pl.col
    kept = points.unique(["id", "time", "position", "lane_number"], keep="first")
    wait, move = c("time").diff(), c("position").diff()
    follows = (c("id").diff() == 0) & (wait >= 0.0) & (wait <= longest_gap) & ~_backwards(move)
    found = (
        kept.sort("id", "row", "time")
        .group_by(stretch=follows.fill_null(False).not_().cum_sum())
        .agg(c("group").first(), first=c("row").first(), last=c("row").last(),
             begin=c("time").first(), end=c("time").last(), n=pl.len())
        .drop("stretch")
    )  # fmt: skip
    return found if 2 * len(found) <= len(kept) else found.clear()


def earlier(points: pl.DataFrame, longest_gap: float) -> pl.DataFrame:
    """Return points (row, id, before [s], at [s]) at which a vehicle drives on, but earlier.

    Args:
        points: Points of some vehicles, as for `whole_seconds`, in the order of the file.
        longest_gap: Longest time between two points of a stretch [s].
    """
    c = pl.col
    wait, move = (c(name).diff().over("id") for name in ("time", "position"))
    drives_on = (move > 0.0) & (move <= JUMP) & (wait < -longest_gap)
    found = points.select("row", "id", before=c("time") - wait, at="time", on=drives_on)
    return found.filter("on").drop("on")


def steps_together(found: pl.DataFrame, within: float) -> list[tuple[int, float, float]]:
    """Return where vehicles drive on, but earlier, most of them at one time [s], as `steps_back`.

    So they do in a file that is sorted by vehicle and whose clock was set back.
    """
    c = pl.col
    same = [(c(name) - c(name).median()).abs() <= within for name in ("before", "at")]
    together = found.sort("row").filter(*same)
    many = together["id"].n_unique() >= FEWEST_TOGETHER and 2 * len(together) > len(found)
    return together.select("row", "before", "at").rows() if many else []


def steps_back(found: pl.DataFrame) -> tuple[list[tuple[int, float, float]], bool]:
    """Return where the time of a file that is sorted by time steps back.

    Such a file has several recordings, or its clock was set back. A file that is sorted by vehicle
    has none: there, the rows of vehicles that are on the road at one time do not alternate.

    Args:
        found: All its `stretches`.

    Returns:
        The row, and the times before and at it [s], of each step; and whether traffic before and
        after any lies over one another.
    """
    c = pl.col
    found = found.sort("group", "first")
    lasting = found.filter(c("n") > 1)
    frame = lasting.select(((c("end") - c("begin")) / (c("n") - 1)).median()).item() or 0.0

    def before(expr: pl.Expr) -> pl.Expr:
        return expr.shift().over("group")

    together = (c("begin") < before(c("end")) - frame) & (before(c("begin")) < c("end") - frame)
    alternate = c("first") < before(c("last"))
    by_time = found.select((together & alternate).sum() > (together & ~alternate).sum()).item()
    # Blocks of rows that no vehicle's stretch connects.
    block = (c("first") > before(c("last").cum_max())).fill_null(False).cum_sum()
    blocks = (
        found.with_columns(block=block)
        .group_by("group", "block")
        .agg(c("first").min(), c("begin").min(), c("end").max())
    )
    latest = before(c("end").cum_max())
    overlap = pl.min_horizontal("end", latest) - c("begin") > 1.01 * frame
    overlaps = blocks.sort("group", "begin").select(overlap & latest.is_not_null())
    back = by_time & (c("begin") < c("before") - 1.01 * frame)
    steps = blocks.sort("group", "first").with_columns(before=before(c("end"))).filter(back)
    rows = steps.sort("first").select("first", "before", "begin").rows()
    return rows, bool(rows) and bool(overlaps.to_series().any())


def _derived(points: pl.DataFrame, place: IntArray, second: IntArray) -> FloatArray:
    """Return mean speeds [km/h] around seconds, from positions of the same piece.

    A piece of a single point has none: NaN.
    """
    time, position, piece = (points[name].to_numpy() for name in ("time", "position", "chain"))
    first = np.searchsorted(piece, np.arange(piece[-1] + 1))
    last = np.append(first[1:], len(piece)) - 1
    start = np.maximum(second - HALF_WIDTH, time[first[piece[place]]])
    end = np.minimum(second + HALF_WIDTH, time[last[piece[place]]])
    # Pieces one after another on a single axis, so that one interpolation serves all.
    lengths = time[last] - time[first]
    offset = np.concatenate([[0.0], np.cumsum(lengths + 1.0)[:-1]]) - time[first]
    axis, shift = time + offset[piece], offset[piece[place]]
    moved = np.interp(end + shift, axis, position) - np.interp(start + shift, axis, position)
    none = np.full(len(place), np.nan)
    speed: FloatArray = np.divide(HOUR * moved, end - start, none, where=end > start)
    return speed


def _pieces(points: pl.DataFrame, counts: Counter[str]) -> pl.DataFrame:
    """Return begin, end, move [km] and the ratio of speeds to positions of each piece."""
    c = pl.col
    mean = 0.5 * (c("next_speed") + c("speed"))
    # As its speeds say, by the trapezoidal rule.
    driven = pl.when("joined").then(mean * c("wait") / HOUR).otherwise(0.0)
    pieces = points.group_by("chain", maintain_order=True).agg(
        group=c("group").first(), begin=c("time").first(), end=c("time").last(),
        enters=c("column").first(), leaves=c("column").last(), n=c("n").sum(), n_points=pl.len(),
        move=c("position").last() - c("position").first(),
        driven=pl.when(c("speed").null_count() == 0).then(driven.sum()),
    )  # fmt: skip
    counts.update(pieces=len(pieces), too_short=pieces.filter(c("n") == 0).height)
    return pieces.drop("chain", "n").with_columns(ratio=c("driven") / c("move").abs())


def count_ends(
    pieces: pl.DataFrame, coverage: Mapping[str, tuple[float, float]], branches: Branches
) -> Counter[str]:
    """Count where the pieces of trajectories begin and end: at an entry, or amid the road."""
    road = branches.corridor.road
    first_time, last_time = (
        pl.col("group").replace_strict({g: c[i] for g, c in coverage.items()}) for i in (0, 1)
    )
    at_start, at_end = pl.col("begin") < first_time + 1.0, pl.col("end") > last_time - 1.0
    enters, leaves = (
        pl.col("enters").is_in(np.append(road.entries, road.entry_cells)),
        pl.col("leaves").is_in(np.append(road.exits, road.exit_cells)),
    )
    told = pieces.select(
        present_at_start=at_start.sum(), entered=(enters & ~at_start).sum(),
        appeared=(~enters & ~at_start).sum(), present_at_end=at_end.sum(),
        left=(leaves & ~at_end).sum(), vanished=(~leaves & ~at_end).sum(),
    )  # fmt: skip
    return Counter(told.row(0, named=True))


def check_pieces(
    pieces: pl.DataFrame, source: Source, units: Mapping[str, str], where: str
) -> float | None:
    """Return the median ratio of given speeds to those of positions, of the longer pieces.

    Args:
        pieces: The pieces of all trajectories of a file.
        source: What was said of the file.
        units: Its unit by quantity.
        where: The file, for messages.

    Raises:
        TrajectoryError: Vehicles or speeds are backwards, or as none are; see `check_units`.
    """
    distance = pl.col("move").abs()
    pieces = pieces.filter(distance >= pl.max_horizontal(distance.median(), 1e-9))
    share = pieces.filter(pl.col("move") < 0.0).height / max(len(pieces), 1)
    if share > 0.1:
        told = "one direction must be chosen by source.where or source.groups"
        if share > 0.9:
            told = (
                "layout.reversed must be turned round, and layout.origin be where the road begins "
                "upstream"
            )
        raise TrajectoryError(
            f"{where}: {told}, got positions that decrease for {100.0 * share:.0f} % of the "
            "vehicles"
        )
    time = pl.col("end") - pl.col("begin")
    step, speed, ratio = (
        pieces.filter(time > 0.0)
        .select(
            step=(time / (pl.col("n_points") - 1)).median(),
            speed=(HOUR * pl.col("move") / time).median(),
            ratio=pl.col("ratio").drop_nans().median(),
        )
        .row(0)
    )
    if ratio is not None and ratio < 0.0:
        raise TrajectoryError(
            f"{where}: speeds must be positive along the road, got {ratio:.4g} times those that "
            "positions say"
        )
    if step is not None:
        check_units(Motion(step, speed, ratio), source, units, where, whole=True)
    return ratio  # type: ignore[no-any-return]  # None without speeds
