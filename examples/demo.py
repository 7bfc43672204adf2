r"""Train a query policy for two minutes, and show what it is worth on other traffic.

python examples/demo.py

It runs ``dptse train`` and ``dptse evaluate`` on the short road, which has one query a second and
the best estimator there is, and draws four bars. The best rule is that on validation traffic. The
folder results/demo has the policy, its learning curve, and the errors as a table and a figure.
"""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import tyro

COMMAND = Path(sys.executable).with_name("dptse")
ENV = "dptse_env:dptse/ShortHighway-v0"
ALGORITHM = 'ppo {"validations": 8}'
WIDTH = 40
"""Letters of the longest bar."""


def run(*words: object, printed: bool = True) -> str:
    """Run a command of the package; return what it prints, or let it be seen."""
    line = [*map(str, words)]
    print("$ dptse", shlex.join(line), flush=True)
    kept = None if printed else subprocess.PIPE
    return subprocess.run([COMMAND, *line], stdout=kept, check=True, text=True).stdout


def main(
    minutes: float = 2.0, test_seeds: str = "2000:2064", output: Path = Path("results/demo")
) -> None:
    """Train, evaluate, and draw the bars."""
    training = output / "training"
    policy = training / "best.safetensors"
    seeds = "--train-seeds", "0:64", "--validation-seeds", "1000:1016"
    how = "--algorithm", ALGORITHM, "--minutes", minutes
    progress = training / "progress.csv"
    print(f"training for {minutes:g} minutes of processor time; {progress} has each validation")
    run("train", "--env", ENV, *how, *seeds, "--output", training)
    rules = json.loads((training / "rules.json").read_text(encoding="utf-8"))
    rule = min(rules, key=rules.get)
    print(f"playing traffic {test_seeds}, a minute on quiet cores")
    found = run(
        "evaluate", "--env", ENV, "--policies", policy, "round-robin", rule, "all",
        "--reference", rule, "--test-seeds", test_seeds, "--output", output, "--force", "--json",
        printed=False,
    )  # fmt: skip
    rows = {row["policy"]: row for row in json.loads(found)["rows"]}
    (learned,) = rows.keys() - {"round-robin", rule, "all"}
    names = {
        "round-robin": "round robin", rule: f"best rule, {rule}", learned: "learned policy",
        "all": "every segment queried",
    }  # fmt: skip
    longest = max(row["means"]["error"]["mean"] for row in rows.values())
    print("\nerror x 1000, with density [veh/km] and speed [km/h]")
    for name, words in names.items():
        error, density, speed = (
            rows[name]["means"][key]["mean"] for key in ("error", "rmse_density", "rmse_speed")
        )
        bar = "█" * round(WIDTH * error / longest)
        print(f"{words:<30} {error:5.1f} {density:5.1f} {speed:5.1f}  {bar}")
    least, less = rows[rule]["means"]["error"]["mean"], rows[learned]["differences"]["error"]
    mean, low, high = (-100.0 * less[key] / least for key in ("mean", "high", "low"))
    side = "below" if mean >= 0.0 else "above"
    print(
        f"\nThe learned policy is {abs(mean):.1f} % {side} the best rule. The 95 % interval over "
        f"traffic is {low:.1f} to {high:.1f} % below."
    )


if __name__ == "__main__":
    tyro.cli(main)
