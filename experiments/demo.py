"""The whole way once, at a small budget: collect, identify, test, report.

python experiments/demo.py [--bench <folder of servo-bench logs>] [--out outputs/demo]

A stand-in robot squats and its parameters are identified with and without directional transmission efficiency; where
logs of a real servo are at hand (``--bench``, or ``../shared/data/servo_bench/sts3032``) that servo is identified too.
The last two lines printed are the paths of the page and of result.yaml.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from op3.report import Page, finish, read_result, run_provenance, write_result

HERE = Path(__file__).resolve().parent
BENCH = HERE.parent.parent / "shared" / "data" / "servo_bench" / "sts3032"


def run(what: str, script: str, *arguments: str) -> None:
    """Run one experiment as its user would, and stop the demo if it fails."""
    print(f"{what}: python experiments/{script} {' '.join(arguments)}", flush=True)
    done = subprocess.run([sys.executable, str(HERE / script), *arguments], check=False)
    if done.returncode:
        raise SystemExit(f"{what} failed with exit code {done.returncode}; its message stands above")


def identify(what: str, folder: Path, *arguments: str) -> dict:
    """Identify, and read the numbers back."""
    run(what, "identify.py", f"hydra.run.dir={folder}", *arguments)
    return read_result(folder / "result.yaml")


def squat(out: Path) -> dict:
    """Collect two squats from the stand-in and identify it."""
    for motion in ("squat", "squat_heldout"):
        run("Collect", "collect.py", "robot=stand_in", f"motion={motion}", f"hydra.run.dir={out / motion}")
    data = [f"data={out / 'squat' / 'squat-0'}", f"heldout={out / 'squat_heldout' / 'squat_heldout-0'}"]
    return identify("Identify the robot", out / "robot", *data, "method=lsq")


def page(out: Path, robot: dict, servo: dict | None, seconds: float) -> Page:
    """One page over both identifications."""
    ratio = robot["loss.fit_without_dte"] / robot["loss.fit"]
    lead = f"Directional transmission efficiency lowers the loss of a squat by a factor of {ratio:.1f}."
    if servo is not None:
        lead += (
            " On a real servo that others recorded, runs at a gain the fit has not seen are predicted with a mean"
            f" error of {servo['error_mrad.heldout']:.1f} mrad,"
            f" without it {servo['error_mrad.heldout_without_dte']:.1f}."
        )
    page = Page("op3 demo", lead)
    page.tile("squat, loss", robot["loss.fit"], note=f"{robot['loss.fit_without_dte']:.3g} without DTE")
    page.tile("held-out squat", robot["loss.heldout"], note=f"{robot['loss.heldout_without_dte']:.3g} without DTE")
    page.tile("backward efficiency", robot["parameters.backward_efficiency"]["value"])
    if servo is not None:
        page.tile("real servo, held out", servo["error_mrad.heldout"], "mrad")
    page.tile("time", seconds, "s")
    page.section("A robot from a squat")
    page.text(
        "A simulated stand-in for the real OP3, with its own physics code, time step, friction law and noisy sensors,"
        " squats on the floor for five seconds. Its parameters are found from that log alone and tested on a squat of"
        " another speed and depth."
    )
    page.files({"robot/index.html": "the identification of the robot", "robot/model.yaml": "its model"})
    page.section("A real servo")
    if servo is None:
        page.text(
            "No servo-bench logs were found, so this part was left out. Give their folder with"
            " `python experiments/demo.py --bench <folder>`."
        )
    else:
        page.text("A Feetech STS3032 swings a pendulum, recorded by Rhoban; runs with firmware gain 8 were held out.")
        page.files({"servo/index.html": "the identification of the servo", "servo/model.yaml": "its model"})
    page.provenance(run_provenance(seed=0))
    return page


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the demo."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--bench", type=Path, default=BENCH if BENCH.is_dir() else None, help="servo-bench logs")
    parser.add_argument("--out", type=Path, default=Path("outputs/demo"), help="where results go")
    options = parser.parse_args(arguments)
    if options.bench is not None and not options.bench.is_dir():
        parser.error(f"--bench: there is no folder {options.bench}")
    started = time.monotonic()
    out = options.out / time.strftime("%Y-%m-%d_%H-%M-%S")
    robot = squat(out)
    servo = None
    if options.bench is not None:
        where = [f"data={options.bench}", "hydra.sweeper.n_trials=1000"]
        servo = identify("Identify the servo", out / "servo", "experiment=servo_bench", *where)
    seconds = time.monotonic() - started
    values = {"wall_seconds": seconds}
    for name, numbers in (("robot", robot), ("servo", servo)):
        values |= {f"{name}.{key}": value for key, value in (numbers or {}).items() if "provenance" not in key}
    page_path = page(out, robot, servo, seconds).write(out / "index.html")
    result_path = write_result(
        out / "result.yaml", values, {"robot": "identification of the stand-in", "servo": "identification of a servo"}
    )
    finish(page_path, result_path)


if __name__ == "__main__":
    main()
