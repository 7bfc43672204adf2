"""Random configurations and hostile files: each works, or is refused in one line with a path.

    python -m tests.fuzz                     # 1,000 configurations and 400 files, ten minutes
    python -m tests.fuzz --only roads:17     # one of them again

A case is drawn from the seed, its kind and its number, and tried in another process: it may take
`LONGEST` seconds of the processor and `MEMORY` bytes beyond those of the imports. What raises
anything but a `ValueError` of one line that begins with the keyword or has the file, takes longer,
needs more, or kills the process, has escaped; the exit status says whether any has.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import dataclasses
import faulthandler
import gzip
import io
import json
import math
import multiprocessing
import resource
import shutil
import sys
import tempfile
import time
import traceback
import types
import typing
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np
import polars as pl

import dptse_env
from agents.policies import find_policy
from dptse_env import config
from dptse_env.config import EnvConfig
from dptse_env.estimators import ESTIMATORS
from dptse_env.estimators.tuned import available_settings, load_settings, write_settings
from dptse_env.importers import Layout, Source, import_trajectories
from dptse_env.importers.fields import FieldRoad, FieldSource, import_field
from dptse_env.importers.folder import Split
from dptse_env.importers.source import read_source
from dptse_env.importers.sumo_net import import_road, read_configuration, segment_path
from dptse_env.model import ARZParameters, load_parameters
from dptse_env.model.parameters import write_parameters
from dptse_env.policies import TRANSFERABLE, read_policy, shipped_policies
from dptse_env.registration import ENVIRONMENTS
from dptse_env.release import RELEASE_MODELS
from dptse_env.spaces.actions import ACTION_ENCODINGS
from dptse_env.spaces.observations import BLOCKS
from dptse_env.spaces.rewards import REWARDS
from dptse_env.traffic import CORRIDORS, SHORT_HIGHWAY, Corridor, write_corridor
from dptse_env.utils.validation import Interval, field_hints
from tests.hostile import ODD, changed, changed_tensors
from tests.importers.data import PLAIN, SPLITS, STRAIGHT, plain, stream
from tests.importers.sumo_net.conftest import PATH, motorway
from tests.importers.test_tables import i24, text_of_ngsim

LONGEST = 60.0
"""Processor time of a case [s]; those that are in order take a few seconds."""
MEMORY = 500 * 2**20
"""Bytes of a case beyond the most that the process took before."""
GUARD = 16 * 2**30
"""Bytes that a process may reserve, so that a case does not take all of the machine's."""
PATIENCE = 600.0
"""Time after which a process is ended, whatever else the machine does [s]."""
LONGEST_MESSAGE = 1500
"""Characters of a message, its path aside."""

SHIPPED = Path(dptse_env.__file__).parent
KEYWORDS = (*config.KEYWORDS, *config.SHORTCUTS)
PATHS = (*KEYWORDS, r"no_such\nkeyword", "none.toml", "none.json")
"""Beginnings of messages on a configuration."""


# --- configurations -------------------------------------------------------------------------------


def some(hint, rng, wrong=0.02):
    """A value of an annotated type as plain JSON, or here and there one that is `ODD`."""
    if rng.random() < wrong:
        return ODD[rng.integers(len(ODD))]
    origin, items, interval = typing.get_origin(hint), typing.get_args(hint), None
    if origin is typing.Annotated:
        hint, *extras = items
        interval = next((each for each in extras if isinstance(each, Interval)), None)
        origin, items = typing.get_origin(hint), typing.get_args(hint)
    if hint is int or hint is float:
        return some_number(hint, interval or Interval(-1000, 1000), rng)
    if hint is bool:
        return bool(rng.integers(2))
    if origin in (typing.Union, types.UnionType):
        return some(items[rng.integers(len(items))], rng, wrong)
    if origin is typing.Literal:
        return items[rng.integers(len(items))]
    if origin is tuple and items[1:] == (...,):
        values = [some(items[0], rng, wrong) for _ in range(rng.integers(5))]
        with contextlib.suppress(TypeError, IndexError):  # steps from time 0 on, rather
            values = [[0.0, *values[0][1:]], *sorted(values[1:])] if rng.random() < 0.8 else values
        return values
    if origin is tuple:
        return [some(each, rng, wrong) for each in items]
    if dataclasses.is_dataclass(hint):
        return some_fields(hint, rng, wrong)
    return None if hint is type(None) else "name"


def some_number(kind, interval, rng):
    """A number of an interval: an end, next to one, amid it, or of any size in between."""
    low, high = max(interval.low, -1e308), min(interval.high, 1e308)
    amid = low + (min(high, 1e6) - low) * rng.random() ** 4
    size = min(max(10.0 ** rng.uniform(-12, 12), low), high)
    value = (low, high, math.nextafter(low, high), amid, amid, amid, size)[rng.integers(7)]
    return math.floor(value) if kind is int else float(value)


def some_fields(cls, rng, wrong, n=3):
    """A mapping of those fields of a dataclass that must be given, and of some others."""
    missing, hints = dataclasses.MISSING, field_hints(cls)
    needed = [
        field.name
        for field in dataclasses.fields(cls)
        if field.name in hints and field.default is missing and field.default_factory is missing
    ]
    chosen = {*needed, *rng.choice([*hints], min(len(hints), int(rng.integers(n + 1))), False)}
    return {str(name): some(hints[name], rng, wrong) for name in hints if name in chosen}


def one_of(names, rng):
    names = [*names]
    return names[rng.integers(len(names))]


NAMES = {
    "corridor": [*CORRIDORS, "none.toml"],
    "estimator": [*ESTIMATORS],
    "parameters": ["published", "w99-3lane", "none.json"],
    "estimator_settings": [*available_settings(), "none.json"],
    "action": [*ACTION_ENCODINGS],
    "reward": [*REWARDS],
    "backend": ["compiled", "compiled", "reference"],
    "query_spans": [[1], [1, 2], [1, 2, 4], [2]],
    "bandwidth_unit": ["segments", "sums"],
    "bandwidth": [1, 2, 3, 1000],
    "horizon": [1, 5, 240, 241],
    "incident": ["preset", "none", "random"],
    "demand": ["preset", "random"],
    "traffic_seeds": ["0:2", "0:20000", "1:0", [0, 1], [1, 1], [], [5e-324]],
}
"""Values of keywords beside mappings of fields."""
ONLY_NAMES = ("estimator", "action", "reward", "backend", "bandwidth_unit")


def keyword(name, rng, given):
    """A value of a keyword, given those that were drawn before."""
    hints = {**field_hints(EnvConfig), **Corridor.hints()}
    if rng.random() < 0.05:
        return ODD[rng.integers(len(ODD))]
    if name in NAMES and (rng.random() < 0.5 or name in ONLY_NAMES):
        return one_of(NAMES[name], rng)
    match name:
        case "corridor":  # any fields, since the others are those of the road that is changed
            fields = rng.choice([*Corridor.hints()], int(rng.integers(4)), replace=False)
            return {str(field): some(hints[str(field)], rng) for field in fields}
        case "epsilon" | "delta":
            return float(10.0 ** rng.uniform(-5, 3 if name == "epsilon" else 0))
        case "parameters":
            return some_fields(ARZParameters, rng, 0.02)
        case "estimator_settings":
            estimator = given.get("estimator")
            known = estimator if estimator in NAMES["estimator"] else "ekf"
            return some_fields(ESTIMATORS.find(known).settings_type, rng, 0.02)
        case "observation":
            return [one_of(["default", *BLOCKS], rng) for _ in range(rng.integers(1, 4))]
        case "privacy":
            preset = one_of(RELEASE_MODELS, rng)
            fields = some_fields(RELEASE_MODELS.find(preset).settings_type, rng, 0.02)
            return {**fields, "preset": preset}
    return some(hints[name], rng)


def configuration(rng, _folder):
    """Draw an id and keywords; return them, what is tried, and what a message may begin with."""
    env = one_of(ENVIRONMENTS, rng)
    env = "dptse/ShortHighway-v0" if rng.random() < 0.6 else env
    keywords = {"horizon": 5, "traffic_seeds": [0]} if rng.random() < 0.9 else {}
    chosen = {*rng.choice(KEYWORDS, int(rng.integers(1, 6)), replace=False)}
    for name in KEYWORDS:  # the estimator before its settings
        if name in chosen:
            keywords[name] = keyword(name, rng, keywords)
    if rng.random() < 0.02:
        keywords = {"no_such\nkeyword": 1}  # alone, since Gymnasium repeats all of them
    return {"id": env, **keywords}, lambda: play(env, keywords), PATHS


def play(env, keywords, n_steps=3):
    """Make an environment and, where its records are small, play a few steps."""
    made = gym.make(f"dptse_env:{env}", **keywords)
    bare, corridor = made.unwrapped, made.unwrapped.config.corridor
    assert bare.process.n_episodes == 1
    size = corridor.conditions.duration * corridor.geometry.n_segments
    if (
        size > SHORT_HIGHWAY.conditions.duration * SHORT_HIGHWAY.geometry.n_segments * 4
        and corridor not in (CORRIDORS.values())
    ):
        return  # SUMO would take most of the time
    observation, _ = made.reset(seed=0)
    made.action_space.seed(0)
    for _ in range(min(n_steps, bare.config.horizon_steps)):
        assert made.observation_space.contains(observation)
        observation, reward, *_ = made.step(made.action_space.sample())
        assert math.isfinite(reward)


# --- files ----------------------------------------------------------------------------------------

# Each function returns the damaged file, what is tried with it, and, where another file may be
# blamed for it, what a message must have instead of its path.


def roads(rng, folder):
    """Draw a road file."""
    path = folder / "road.toml"
    table = {"bandwidth": 2, "horizon": 5, "traffic_seeds": [0], "estimator": "ekf",
             "observation": ["default"], "privacy": {"preset": "paced"},
             "estimator_settings": {"process_noise": [0.01, 0.01]}}  # fmt: skip
    write_corridor(path, SHORT_HIGHWAY.replaced(duration=60, incident=None), table)
    path.write_bytes(changed(path.read_bytes(), rng))
    return path, lambda: play("dptse/ShortHighway-v0", {"corridor": str(path)})


def policies(rng, folder):
    """Draw the file of a policy, read it and let it act."""
    name, path = one_of(shipped_policies(), rng), folder / "policy.safetensors"
    path.write_bytes(changed_tensors(SHIPPED / "policies" / f"{name}.safetensors", rng))

    def act():
        policy, card = find_policy(str(path)), read_policy(name).card
        env = gym.make(card["env"], **{**card["keywords"], **policy.keywords})
        acting = policy.load(env, allow=TRANSFERABLE)
        observation = np.zeros(env.observation_space.shape, np.float32)
        assert env.action_space.contains(acting.predict(observation, deterministic=True)[0])

    return path, act


def weights(rng, folder):
    """Draw the file of a recurrent network, and play with it."""
    shipped = sorted((SHIPPED / "estimators" / "weights").glob("*.safetensors"))
    path = folder / "weights.safetensors"
    path.write_bytes(changed_tensors(one_of(shipped, rng), rng))
    settings = {"recurrent": {"weights": str(path)}}
    keywords = {"estimator": "recurrent", "estimator_settings": settings, "traffic_seeds": [0]}
    return path, lambda: play("dptse/ShortHighway-v0", keywords)


def imported(folder):
    """Import a small recording; return the road file."""
    path = plain(folder / "a.csv", stream(seconds=45.0, period=0.5))
    split = [Split("training", 1.0, range(1000))]
    environment = {"bandwidth": 2, "horizon": 5, "traffic_seeds": [0]}
    import_trajectories([path], PLAIN, STRAIGHT, folder / "new", split, environment=environment)
    return folder / "new" / "road.toml"


def records(rng, folder):
    """Draw a record in a folder of recordings, and play it."""
    road = imported(folder)
    path = road.parent / "records" / "00000000.safetensors"
    path.write_bytes(changed_tensors(path, rng))
    return path, lambda: play("dptse/ShortHighway-v0", {"corridor": str(road)})


def fcd(points):
    """Points as SUMO writes them, on a road of segments of 100 m."""
    steps = []
    for second in np.unique(points[:, 1]):
        vehicles = "\n".join(
            f'<vehicle id="{v:.0f}" lane="main_{x // 100:.0f}_0" pos="{x % 100:.3f}" speed="{u}"/>'
            for v, time, x, u in points
            if time == second
        )
        steps.append(f'<timestep time="{second:.2f}">\n{vehicles}\n</timestep>')
    return "\n".join(["<fcd>", *steps, "</fcd>"])


FORMATS = {
    "csv": PLAIN,
    "csv.gz": PLAIN,
    "txt": Source("ngsim"),
    "json": Source("i24", layout=Layout(origin=310000.0)),
    "xml": Source("fcd"),
    "parquet": PLAIN,
}


def trajectories(rng, folder):
    """Draw a file of trajectories in one of several formats, and import it."""
    points, kind = stream(seconds=45.0, period=0.5), one_of(FORMATS, rng)
    path, source = folder / f"a.{kind}", FORMATS[kind]
    table, parquet = plain(folder / "plain.txt", points), io.BytesIO()
    pl.read_csv(table).write_parquet(parquet)
    text = {
        "parquet": parquet.getvalue,
        "txt": lambda: "\n".join(text_of_ngsim(points)).encode(),
        "json": lambda: json.dumps(i24(points)).encode(),
        "xml": lambda: fcd(points).encode(),
    }.get(kind, table.read_bytes)()
    text = changed(text, rng)
    path.write_bytes(gzip.compress(text) if kind == "csv.gz" else text)
    return path, lambda: import_trajectories([path], source, STRAIGHT, folder / "new", SPLITS)


def fields(rng, folder):
    """Draw a table of a measured field, and import it."""
    density, speed = folder / "density.txt", folder / "speed.txt"
    np.savetxt(density, rng.uniform(20.0, 60.0, (8, 40)), fmt="%.4g")
    np.savetxt(speed, rng.uniform(60.0, 100.0, (8, 40)), fmt="%.4g")
    path = one_of([density, speed], rng)
    path.write_bytes(changed(path.read_bytes(), rng))
    source = FieldSource(density, cell=0.05, interval=5.0, speed=speed)
    road = FieldRoad(segments=2, lanes=3, speed_limit=100.0)
    # Of two files that do not fit one another either may be named.
    return path, lambda: import_field(source, road, folder / "new", SPLITS, 40), folder


SOURCE = """
format = "table"
frame_rate = 25
groups = [1, "a"]
columns = { time = "t" }
units = { speed = "m/s" }
[layout]
origin = 1.0
centre_line = [[0, 0], [1, 1]]
mainline = { lanes = [1, 2], lateral = [0.0, 3.5] }
"""


def cards(rng, folder):
    """Draw a JSON or TOML file of parameters, settings, a mapping or a manifest, and use it."""
    kind = one_of(["parameters", "estimator_settings", "source", "manifest"], rng)
    path = folder / f"{kind}.json"
    keywords = {"horizon": 5, "traffic_seeds": [0], kind: str(path)}
    match kind:
        case "parameters":
            write_parameters(path, load_parameters("w99-3lane"), {"by": "hand"})
        case "estimator_settings":
            settings = dataclasses.asdict(load_settings("ekf-w99-3lane-paced"))
            del settings["demand"]
            context = {"estimator": "ekf", "parameters": "w99-3lane", "privacy": "paced"}
            write_settings(path, **context, settings=settings, provenance={})
        case "manifest":
            road = imported(folder)
            path, keywords = road.parent / "manifest.json", {"corridor": str(road)}
        case "source":
            path.write_text(SOURCE)
    path.write_bytes(changed(path.read_bytes(), rng))
    if kind == "source":
        return path, lambda: read_source(path)
    return path, lambda: play("dptse/ShortHighway-v0", keywords)


@cache
def town():
    """A SUMO network with its routes and configuration, as a folder."""
    folder = Path(tempfile.mkdtemp(prefix="dptse-fuzz-town-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    motorway(folder)
    (folder / "town.sumocfg").write_text(
        '<configuration>\n<input>\n<net-file value="road.net.xml"/>\n'
        '<route-files value="road.rou.xml"/>\n</input>\n<time>\n<begin value="0"/>\n'
        '<step-length value="0.5"/>\n</time>\n</configuration>\n'
    )
    return folder


def networks(rng, folder):
    """Draw a SUMO network, its routes or its configuration, and import the road."""
    shutil.copytree(town(), folder, dirs_exist_ok=True)
    path = folder / one_of(["road.net.xml", "road.rou.xml", "town.sumocfg"], rng)
    path.write_bytes(changed(path.read_bytes(), rng))

    def use():
        files = read_configuration(folder / "town.sumocfg")
        import_road(files, segment_path(files, PATH, 100.0), "motorway", 30)

    return path, use, folder  # what one file lacks another may be blamed for


FILES = {
    each.__name__: each
    for each in (roads, policies, weights, records, trajectories, fields, cards, networks)
}
KINDS = {"configurations": configuration, **FILES}


# --- verdicts -------------------------------------------------------------------------------------


def verdict(use, place):
    """Try a case: "worked", "refused: ...", or "escaped: ..." with what happened.

    Args:
        use: What is tried.
        place: The file, or what a message may begin with.
    """
    began, before = time.process_time(), peak()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            use()
        said = "worked"
    except ValueError as problem:
        said = judged(str(problem), place)
    except BaseException as problem:
        line = " ".join(traceback.format_exception_only(problem)[-1].split())
        where = traceback.extract_tb(problem.__traceback__)[-1]
        said = f"escaped: {line:.300} ({where.filename}:{where.lineno})"
    took, more = time.process_time() - began, peak() - before
    if took > LONGEST or more > MEMORY:
        return f"escaped: it took {took:.1f} s and {more / 2**20:.0f} MB, {said:.200}"
    return said


def peak():
    """Return the largest memory of this process so far [bytes]."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def judged(message, place):
    """Say whether a message has one line, a path, and not too many words."""
    if isinstance(place, Path):
        has_path, length = str(place) in message, len(message.replace(str(place), ""))
    else:
        has_path, length = message.startswith(tuple(place)), len(message)
    n_lines = len(message.splitlines())
    if n_lines == 1 and has_path and length <= LONGEST_MESSAGE:
        return f"refused: {message}"
    path = "a" if has_path else "no"
    return f"escaped: {n_lines} lines, {length} characters, {path} path: {message:.300}"


def try_case(seed, kind, number):
    """Draw a case and try it, again if it takes long; return a verdict, and what was drawn."""
    for _ in range(2):  # kernels were compiled the first time, perhaps
        rng = np.random.default_rng([seed, [*KINDS].index(kind), number])
        with tempfile.TemporaryDirectory(prefix="dptse-fuzz-") as name:
            drawn, use, *place = KINDS[kind](rng, folder := Path(name))
            before = {*folder.rglob("*")}
            said = verdict(use, *place or [drawn])
            drawn = drawn.read_bytes() if isinstance(drawn, Path) else drawn
            left = {*folder.rglob("*")} - before
        if left and said.startswith("refused"):
            said = f"escaped: it left {min(left)}, {said:.200}"
        if not said.startswith("escaped: it took"):
            break
    return said, drawn


def guard():
    """Have a process say where it dies, and not take all of the machine's memory."""
    faulthandler.enable()
    resource.setrlimit(resource.RLIMIT_AS, (GUARD, resource.RLIM_INFINITY))


def said_of(*case):
    """Return the verdict on a case, or end the process where it takes no end."""
    faulthandler.dump_traceback_later(PATIENCE, exit=True)
    said, _ = try_case(*case)
    faulthandler.cancel_dump_traceback_later()
    return said


def verdicts(seed, cases):
    """Yield the kind and number of each case, and the verdict of a process that may die of it."""
    pool = None
    for case in cases:
        pool = pool or ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), guard)
        try:
            yield *case, pool.submit(said_of, seed, *case).result()
        except BrokenProcessPool:
            pool = None
            yield *case, "escaped: it ended the process"


def cases(configurations, files):
    """Kinds and numbers of as many cases; files are of all kinds in turn."""
    kinds = [*FILES]
    yield from (("configurations", number) for number in range(configurations))
    yield from ((kinds[n % len(kinds)], n // len(kinds)) for n in range(files))


def main():
    """Try all cases; print figures and what has escaped. Return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--configurations", type=int, default=1000)
    parser.add_argument("--files", type=int, default=400)
    parser.add_argument("--only", metavar="KIND:NUMBER", help="one case, with what was drawn")
    args = parser.parse_args()
    if args.only:
        kind, _, number = args.only.partition(":")
        said, drawn = try_case(args.seed, kind, int(number))
        print(drawn, said, sep="\n")
        return int(said.startswith("escaped"))
    figures, outcomes = Counter(), ("worked", "refused", "escaped")
    for kind, number, said in verdicts(args.seed, cases(args.configurations, args.files)):
        figures[kind, said.partition(":")[0]] += 1
        if said.startswith("escaped"):
            print(f"{kind}:{number} {said}", flush=True)
    print(f"{'kind':15}", *(f"{each:>9}" for each in outcomes))
    for kind in KINDS:
        print(f"{kind:15}", *(f"{figures[kind, each]:9}" for each in outcomes))
    return int(any(outcome == "escaped" for _, outcome in figures))


if __name__ == "__main__":
    sys.exit(main())
