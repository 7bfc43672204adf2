"""Files of trajectories as one lazy table, whatever their format.

A format declares the role and the unit of each column, and what else is special. Every file becomes
a `polars.LazyFrame` with the columns of `SCHEMA`, which is read in chunks. Fields are read as text
and parsed afterwards, so that a row with a malformed number is kept and can be named.
"""

from __future__ import annotations

import csv
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.parsers import expat

import polars as pl
from polars.io.plugins import register_io_source

from dptse_env.importers.source import LABELS, NUMBERS, Source, TrajectoryError
from dptse_env.utils.files import open_unzipped
from dptse_env.utils.validation import cut, shown

SCHEMA = {
    "row": pl.Int64,
    **dict.fromkeys(NUMBERS, pl.Float64),
    **dict.fromkeys(LABELS, pl.String),
    "bad": pl.String,
}
"""Columns of a table of points. `row` is the row of the file as an editor counts it; times are in
seconds, lengths in kilometres, speeds in km/h. What a file does not have is null, and so is the
vehicle of a row that has a time alone; `bad` is the role of a field that is no finite number."""

BYTES = 40
"""Bytes that a point takes in XML or JSON at least."""
BLOCK = 1 << 20
"""Bytes of XML that are read at a time."""
CHUNK = 25_000
"""Points of XML that are handed on together."""
LARGEST_JSON = 1 << 28
"""Bytes of a JSON file, which is read at once and takes up six times as much memory."""
HEAD = 1 << 16
"""Bytes at the start of a text file that show its delimiter and columns."""
PARQUET = (".parquet", ".pq")
MISSING = ("", "nan", "null", "none", "<na>")
"""Texts of a label that is missing, in lower case."""
CODES = ("lane", "group")
"""Roles of labels that are codes: those that are one number are one, as 3, 03 and 3.0."""
LARGEST_CODE = 2.0**53
"""Numbers below it are exact."""
ROW = "row of the file"
"""Name of the column of row numbers beside the file's own columns."""


@dataclass(frozen=True)
class Format:
    """A format of trajectories.

    Attributes:
        columns: names that a column may have, by role; compared without regard to case and ``-``.
        units: unit by quantity.
        required: roles that a file must have; others are read if it has them.
        headless: columns of the same table as a text without header.
        lists: fields of a JSON document that are lists of one length, with an entry a point.
        adjust: changes the points of a file, given its path and the source.
        sumo: whether it is SUMO's: lanes are named ``edge_lane``, and the time of a state is that
            at which the step before it begins.
    """

    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    units: Mapping[str, str] = field(
        default_factory=lambda: {"time": "s", "length": "m", "speed": "m/s"}
    )
    required: tuple[str, ...] = ("time", "vehicle", "x")
    headless: tuple[str, ...] = ()
    lists: tuple[str, ...] = ()
    adjust: Callable[[pl.LazyFrame, Path, Source], pl.LazyFrame] | None = None
    sumo: bool = False


class Table(NamedTuple):
    """A file of trajectories.

    Attributes:
        frame: Its points, with the columns of `SCHEMA`.
        roles: The roles of columns that it has.
        rows: Rows, at most by estimate.
    """

    frame: pl.LazyFrame
    roles: set[str]
    rows: int


class _Raw(NamedTuple):
    """Columns of a file, its rows, and whether digits are in groups that commas separate."""

    frame: pl.LazyFrame
    rows: int
    grouped: bool = False


def scan(path: Path, form: Format, source: Source) -> Table:
    """Return the points of a file, which is read when they are collected.

    Raises:
        TrajectoryError: There is no such file, its start is damaged, columns are missing, or a row
            of a text has too many or too few fields.
    """
    raw, rows, grouped = _raw(path, form)
    kinds = raw.collect_schema()
    names = [name for name in kinds.names() if name != ROW]
    roles = _roles(path, form, source, names)
    lengths = dict.fromkeys(("x", "y", "extent"), "length")
    columns: dict[str, Any] = {"row": pl.col(ROW).cast(pl.Int64)}
    for role, name in roles.items():
        is_label, kind = role in LABELS, kinds[name]
        fits = not kind.is_nested() if is_label else kind.is_numeric()
        if not (fits or kind in (pl.String, pl.Null)):
            allowed = "numbers or texts" if is_label else "numbers"
            raise TrajectoryError(f"{path}: {cut(name)} must be {allowed}, got {cut(str(kind))}")
        if is_label:
            columns[role] = _label(kind, name, role)
            continue
        quantity = lengths.get(role, role)
        factor = source.factor(quantity, form.units[quantity])
        columns[role] = _number(kind, name, grouped) * factor
    for name, value in source.where.items():
        found = _find(path, name, names, "source.where")
        # Rows without a vehicle tell times alone.
        raw = raw.filter(columns["vehicle"].is_null() | _equals(found, value))
    layout, lane = source.layout, columns.get("lane")
    wanted = [strip.names for strip in (layout.mainline, *layout.on_ramps, *layout.off_ramps)]
    names_of_lanes = sorted(frozenset().union(*wanted))
    for name, code in zip(names_of_lanes, codes(names_of_lanes), strict=True):
        if lane is not None and code != name:  # as the layout spells it, "01"
            columns["lane"] = pl.when(lane == code).then(pl.lit(name)).otherwise(columns["lane"])
    absent = {name: pl.lit(None, kind) for name, kind in SCHEMA.items() if name not in columns}
    # What is no finite number is named, for the first error.
    numbers = [role for role in NUMBERS if role in roles]
    bad = [pl.when(pl.col(role).is_finite().not_()).then(pl.lit(role)) for role in numbers]
    bad += [pl.when(pl.col(role).is_null()).then(pl.lit(role)) for role in numbers]
    points = (
        raw.select(**columns, **absent)
        .with_columns(bad=pl.when(pl.col("vehicle").is_not_null()).then(pl.coalesce(bad)))
        .select(*SCHEMA)
    )
    if form.sumo and not source.layout.centre_line:
        points = points.with_columns(edge=pl.col("lane").str.extract("^(.*)_"))
        roles["edge"] = "lane"
    if form.sumo:
        points = points.with_columns(lane=pl.col("lane").str.extract("([^_]*)$"))
    if form.adjust:
        points = form.adjust(points, path, source)
    return Table(points, set(roles), rows)


def field_text(path: Path, form: Format, source: Source, row: int, role: str) -> tuple[str, str]:
    """Return the name of a role's column and the text of its field in a row, for messages."""
    raw = _raw(path, form).frame
    name = _roles(path, form, source, raw.collect_schema().names()).get(role, role)
    text = raw.filter(pl.col(ROW) == row).select(pl.col(name).cast(pl.String)).head(1)
    value = text.collect(engine="streaming")
    got = shown(value.item()) if len(value) and value.item() else "nothing"
    return cut(name), got


def _raw(path: Path, form: Format) -> _Raw:
    """Return the columns of a file and `ROW`."""
    try:
        if path.is_dir():
            raise TrajectoryError(f"{path}: trajectories must be a file, got a directory")
        size = path.stat().st_size * (10 if path.suffix.lower() == ".gz" else 1)
        if size == 0:
            raise TrajectoryError(f"{path}: the file is empty")
        kind = "".join(path.suffixes[-2:]).lower().removesuffix(".gz")
        if kind.endswith(PARQUET):
            frame = pl.scan_parquet(
                path.absolute(), glob=False, row_index_name=ROW, row_index_offset=1
            )
            return _Raw(frame, frame.select(pl.len()).collect().item())
        if kind.endswith(".xml"):
            return _Raw(_from(lambda: _xml(path, form)), size // BYTES)
        if kind.endswith(".json"):
            return _Raw(_json(path, form), size // BYTES)
        return _text(path, form)
    except (OSError, EOFError, zlib.error, csv.Error) as problem:
        reason = cut(getattr(problem, "strerror", None) or problem)
        raise TrajectoryError(f"{path}: the file cannot be read: {reason}") from problem


def _text(path: Path, form: Format) -> _Raw:
    with open_unzipped(path) as file:
        text = file.read(HEAD).decode("utf-8-sig", errors="replace")
    if "\0" in text:
        raise TrajectoryError(
            f"{path}: it must be text in UTF-8, got bytes of 0, as in UTF-16 and in packed files"
        )
    first = text.partition("\n")[0].rstrip("\r")
    if not first.strip():
        raise TrajectoryError(f"{path}, row 1: a header or data must be there, got an empty line")
    separator = max(",;\t|", key=first.count)
    blanks = not first.count(separator)
    names = first.split() if blanks else next(csv.reader([first], delimiter=separator))
    has_header = not (form.headless and re.fullmatch(r"[-+\d.eE]+", names[0].strip()))
    if not has_header and len(names) != len(form.headless):
        raise TrajectoryError(
            f"{path}, row 1: a line without header must have {len(form.headless)} columns "
            f"({', '.join(form.headless)}), got {len(names)}"
        )
    names = [name.strip() for name in names] if has_header else list(form.headless)
    # A name that is there twice is that of its first column.
    names = [
        name if names.index(name) == i else f"{name} (column {i + 1})"
        for i, name in enumerate(names)
    ]
    rows = _count_rows(path, None if blanks else separator, len(names))
    options: dict[str, Any] = {
        "infer_schema": False, "has_header": has_header, "row_index_name": ROW,
        "row_index_offset": 1 + has_header, "glob": False,
    }  # fmt: skip
    absolute = path.absolute()  # since polars expands ~
    if not blanks:
        raw = pl.scan_csv(absolute, separator=separator, new_columns=names, **options)
        # "1,118,846,663,000": portals export numbers with their digits in groups.
        grouped = separator == "," and re.search(r'"\d{1,3}(,\d{3})+(\.\d*)?"', text) is not None
        return _Raw(raw, rows, grouped)
    # Runs of blanks: a line is one column first.
    raw = pl.scan_csv(absolute, separator="\x01", quote_char=None, new_columns=["line"], **options)
    fields = pl.col("line").str.extract_all(r"\S+")
    columns = (fields.list.get(i, null_on_oob=True).alias(name) for i, name in enumerate(names))
    return _Raw(raw.select(ROW, *columns), rows)


def _count_rows(path: Path, separator: str | None, n: int) -> int:
    """Count rows; refuse one with more or fewer than `n` fields, which polars would let pass."""
    line = pl.col("line")
    if separator is None:
        words = line.str.count_matches(r"\S+")
        found: pl.Expr = pl.when(words > 0).then(words)
    else:
        quoted = line.str.contains('"', literal=True)
        bare = pl.when(quoted).then(line.str.replace_all(r'"[^"]*"', "")).otherwise(line)
        fields = bare.str.count_matches(separator, literal=True) + 1
        # A quote that its line does not close would join it with the next ones.
        found = pl.when(bare.str.contains('"', literal=True)).then(0).otherwise(fields)
    lines = pl.scan_csv(
        path.absolute(), separator="\x01", quote_char=None, has_header=False, glob=False,
        new_columns=["line"], infer_schema=False, row_index_name="row", row_index_offset=1,
    )  # fmt: skip
    wrong = pl.col("n") != n
    told = (
        lines.select("row", n=pl.when(line.is_not_null()).then(found))
        .select(pl.col("n").count(), row=pl.col("row").filter(wrong).min())
        .collect(engine="streaming")
    )
    rows, row = told.row(0)
    if row is not None:
        got = lines.select("row", n=found).filter(pl.col("row") == row).head(1)
        fields = got.collect(engine="streaming")["n"].item()
        raise TrajectoryError(
            f"{path}, row {row}: it must have {n} fields, got {fields or 'an open quote'}"
        )
    return int(rows)


def _number(kind: Any, name: str, grouped: bool) -> pl.Expr:
    column = pl.col(name)
    if kind == pl.String:
        column = column.str.strip_chars()
        column = column.str.replace_all(",", "", literal=True) if grouped else column
    return column.cast(pl.Float64, strict=False)


def _label(kind: Any, name: str, role: str) -> pl.Expr:
    text = pl.col(name).cast(pl.String).str.strip_chars()
    label = _code(text) if kind.is_float() or role in CODES else text
    return pl.when(text.str.to_lowercase().is_in(MISSING).not_()).then(label)


def _code(text: pl.Expr) -> pl.Expr:
    """Return the shortest text of a code that is a number, and others as they are."""
    number = text.cast(pl.Float64, strict=False)
    whole = pl.when(number == number.round()).then(number).cast(pl.Int64, strict=False)
    code = pl.coalesce(whole.cast(pl.String), number.cast(pl.String))
    return pl.when(number.abs() < LARGEST_CODE).then(code).otherwise(text)


def codes(values: Iterable[object]) -> list[str]:
    """Return values as the codes that a table of points has for them."""
    texts = pl.Series(map(str, values), dtype=pl.String).str.strip_chars()
    return texts.to_frame("text").select(_code(pl.col("text")))["text"].to_list()


def _roles(path: Path, form: Format, source: Source, found: list[str]) -> dict[str, str]:
    """Return the file's column of each role that it has."""
    roles = {
        role: _find(path, name, found, f"source.columns.{role}")
        for role, name in source.columns.items()
    }
    by_name = {_normal(name): name for name in found}
    missing = []
    for role, names in form.columns.items():
        present = [by_name[name] for name in map(_normal, names) if name in by_name]
        if present:
            roles.setdefault(role, present[0])
        elif role in form.required and role not in roles:
            missing.append(" or ".join(names))
    missing += [f"one for {r}" for r in form.required if r not in (*roles, *form.columns)]
    if missing:
        raise TrajectoryError(
            f"{path}: columns must be {', '.join(missing)} among others, found {shown(found)}"
        )
    return roles


def _find(path: Path, name: str, found: Iterable[str], option: str) -> str:
    fits = [each for each in found if _normal(each) == _normal(name)]
    fits = [each for each in fits if each == name] or fits
    if len(fits) != 1:
        raise TrajectoryError(
            f"{path}: {option} must be a column of the file, got {shown(name)}; found "
            f"{shown(fits or [*found])}"
        )
    return fits[0]


def _normal(name: str) -> str:
    return re.sub(r"[\s_-]+", "_", name.strip()).lower()


def _equals(name: str, value: object) -> pl.Expr:
    """Return whether a column has a value, or one of several, as text or as a number."""
    wanted = codes(value if isinstance(value, list | tuple) else [value])
    return _code(pl.col(name).cast(pl.String).str.strip_chars()).is_in(wanted)


# -- XML and JSON ----------------------------------------------------------------------------------


def _from(read: Callable[[], Iterator[pl.DataFrame]]) -> pl.LazyFrame:
    """Return a lazy table of chunks that Python makes; there is one at least."""

    def chunks(
        names: list[str] | None, keep: pl.Expr | None, most: int | None, _size: int | None
    ) -> Iterator[pl.DataFrame]:
        for frame in read():
            chosen = frame if keep is None else frame.filter(keep)
            yield chosen if names is None else chosen.select(names)
            most = None if most is None else most - len(chosen)
            if most is not None and most <= 0:
                return

    return register_io_source(chunks, schema=next(read()).schema)


_ATTRIBUTES = {
    "time": "timestep_time", "id": "vehicle_id", "lane": "vehicle_lane", "speed": "vehicle_speed",
    "pos": "vehicle_pos", "x": "vehicle_x", "y": "vehicle_y",
}  # fmt: skip
"""Attributes of SUMO's XML, and the names that its CSV has for them."""


def _xml(path: Path, form: Format) -> Iterator[pl.DataFrame]:
    """Read the points of SUMO's XML; a row is a line."""
    parser, rows, time = expat.ParserCreate(), [], ""
    wanted = [name for name, column in _ATTRIBUTES.items() if (column,) in form.columns.values()]
    wanted.remove("time")
    schema = {ROW: pl.Int64, "timestep_time": pl.String}
    schema |= {_ATTRIBUTES[name]: pl.String for name in wanted}

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal time
        if tag == "timestep":
            time = attributes.get("time", "")
            rows.append((parser.CurrentLineNumber, time, *[None] * len(wanted)))
        elif tag == "vehicle":
            rows.append((parser.CurrentLineNumber, time, *[attributes[name] for name in wanted]))

    def frame() -> pl.DataFrame:
        made = pl.DataFrame(rows, schema, orient="row")
        rows.clear()
        return made

    parser.StartElementHandler = start
    try:
        with open_unzipped(path) as file:
            while block := file.read(BLOCK):
                parser.Parse(block, False)
                if len(rows) >= CHUNK:
                    yield frame()
            parser.Parse(b"", True)
        yield frame()
    except KeyError as missing:
        raise TrajectoryError(
            f"{path}, row {parser.CurrentLineNumber}: a vehicle must have the attributes "
            f"{', '.join(wanted)}; {missing} is missing"
        ) from missing
    except (expat.ExpatError, EOFError, OSError, zlib.error) as broken:
        raise TrajectoryError(
            f"{path}, row {parser.CurrentLineNumber}: it is no complete XML file: {cut(broken)}"
        ) from broken


def _json(path: Path, form: Format) -> pl.LazyFrame:
    """Return the points of a JSON array with a document for each vehicle; a row is a document."""
    with open_unzipped(path) as file:
        content = file.read(LARGEST_JSON + 1)
    if len(content) > LARGEST_JSON:
        raise TrajectoryError(
            f"{path}: JSON must have at most {LARGEST_JSON} bytes, got more: give larger data as "
            "Parquet or CSV, with the same columns and a row for each point"
        )
    try:
        documents = pl.read_json(content, infer_schema_length=None)
        lists = [name for name in form.lists if name in documents.columns]
        # MongoDB's {"$oid": "..."} is its text; what else is nested is nothing of a point.
        columns = [
            pl.col(name).struct[0].alias(name) if isinstance(kind, pl.Struct) else pl.col(name)
            for name, kind in documents.schema.items()
            if name in lists or not kind.is_nested() or isinstance(kind, pl.Struct)
        ]
        documents = documents.select(columns).with_row_index(ROW, 1)
        for name in lists[:1]:
            documents = documents.filter(pl.col(name).list.len() > 0).explode(lists)
        return documents.lazy()
    except pl.exceptions.PolarsError as broken:
        what = "a complete array of documents, with lists of one length"
        reason = cut(str(broken).partition("\n")[0])
        raise TrajectoryError(f"{path}: JSON must be {what}: {reason}") from broken


# -- formats ---------------------------------------------------------------------------------------


def _by_direction(points: pl.LazyFrame, path: Path, source: Source) -> pl.LazyFrame:
    """Turn the front of each vehicle of highD into a position in its direction of travel."""
    meta = path.with_name(path.name.replace("_tracks.", "_tracksMeta."))
    try:
        table = pl.read_csv(
            meta.absolute(), glob=False, infer_schema=False, columns=["id", "drivingDirection"]
        )
    except (OSError, pl.exceptions.PolarsError) as problem:
        raise TrajectoryError(
            f"{path}: the driving directions must be in {meta} (columns id, drivingDirection), "
            f"got {cut(repr(problem))}"
        ) from problem
    unknown = points.select("vehicle").unique().drop_nulls()
    for (name,) in (
        unknown.join(table.lazy(), how="anti", left_on="vehicle", right_on="id")
        .head(1)
        .collect(engine="streaming")
        .rows()
    ):
        raise TrajectoryError(
            f"{path}: vehicle {cut(name)} is not in {meta}, which has its direction"
        )
    extent = source.layout.extent
    if extent is None and "upper" in (source.groups or ["upper"]) and (table[:, 1] == "1").any():
        raise TrajectoryError(
            f"{path}: layout.extent must be given, the length of the picture in the file's unit, "
            "for the vehicles that move to the left (drivingDirection 1), or source.groups be "
            "['lower']"
        )
    # By membership, since `replace` is not streamed.
    upper = pl.col("vehicle").is_in(table.filter(table[:, 1] == "1")[:, 0].implode())
    length = source.factor("length", "m")
    # x is the left corner of the box: the rear of those that move to the right.
    return points.with_columns(
        x=pl.when(upper)
        .then((extent or 0.0) * length - pl.col("x"))
        .otherwise(pl.col("x") + pl.col("extent")),
        speed=pl.col("speed").abs(),
        group=pl.when(upper).then(pl.lit("upper")).otherwise(pl.lit("lower")),
    )


def _first_lanelet(points: pl.LazyFrame, _path: Path, _source: Source) -> pl.LazyFrame:
    """Take the first of the lanelets that overlap where a vehicle is, separated by semicolons."""
    return points.with_columns(pl.col("lane").str.extract("^([^;]*)"))


NGSIM_COLUMNS = (
    "Vehicle_ID", "Frame_ID", "Total_Frames", "Global_Time", "Local_X", "Local_Y", "Global_X",
    "Global_Y", "v_Length", "v_Width", "v_Class", "v_Vel", "v_Acc", "Lane_ID", "Preceding",
    "Following", "Space_Headway", "Time_Headway",
)  # fmt: skip
"""The 18 columns of the text files; the portal's CSV has these names in a header, and some more."""

FCD = Format(
    {"time": ("timestep_time",), "vehicle": ("vehicle_id",), "x": ("vehicle_pos",),
     "speed": ("vehicle_speed",), "lane": ("vehicle_lane",)},
    required=("time", "vehicle", "x", "speed", "lane"), sumo=True,
)  # fmt: skip
FCD_IN_PLANE = replace(
    FCD,
    columns={**FCD.columns, "x": ("vehicle_x",), "y": ("vehicle_y",)},
    required=("time", "vehicle", "x", "y", "speed"),
)
"""Floating-car data of SUMO by edges, and in the plane where a centre line is given."""

FORMATS: Mapping[str, Format] = {
    "fcd": FCD,
    "ngsim": Format(
        {"time": ("Global_Time",), "vehicle": ("Vehicle_ID",), "x": ("Local_Y",),
         "y": ("Local_X",), "speed": ("v_Vel",), "lane": ("Lane_ID",)},
        {"time": "ms", "length": "ft", "speed": "ft/s"},
        required=("time", "vehicle", "x", "y", "speed", "lane"), headless=NGSIM_COLUMNS,
    ),
    "highd": Format(
        {"time": ("frame",), "vehicle": ("id",), "x": ("x",), "y": ("y",), "extent": ("width",),
         "speed": ("xVelocity",), "lane": ("laneId",)},
        {"time": "frame", "length": "m", "speed": "m/s"},
        required=("time", "vehicle", "x", "extent", "speed", "lane"), adjust=_by_direction,
    ),
    "exid": Format(
        {"time": ("frame",), "vehicle": ("trackId",), "x": ("xCenter",), "y": ("yCenter",),
         "speed": ("lonVelocity",), "lane": ("laneletId",), "group": ("recordingId",)},
        {"time": "frame", "length": "m", "speed": "m/s"},
        required=("time", "vehicle", "x", "y", "speed", "lane"), adjust=_first_lanelet,
    ),
    "i24": Format(
        {"time": ("timestamp",), "vehicle": ("_id",), "x": ("x_position",), "y": ("y_position",),
         "group": ("direction",)},
        {"time": "s", "length": "ft", "speed": "ft/s"},
        lists=("timestamp", "x_position", "y_position"),
    ),
    "tgsim": Format(
        {"time": ("time",), "vehicle": ("id",), "x": ("xloc-kf",), "y": ("yloc-kf",),
         "speed": ("speed-kf",), "lane": ("lane-kf",), "group": ("run-index",)},
        required=("time", "vehicle", "x", "y", "speed"),
    ),
    "table": Format(),
}  # fmt: skip
"""Formats by name; ``table`` is any table whose columns a `Source` names."""
