"""Calibrates simulated cameras and compares with the truth: `python -m benchmarks.calibrate_camera 0 1 2 ...`.

Each seed draws where the camera and the board truly are, and a description that has the camera 2 cm and 3 degrees
elsewhere. A row for a board in the hand before a camera on the robot's head, and one for a camera in the hand before
a board on the table. Exits with 1 where an error is 2 mm or 0.2 degrees or more.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from runner.testing import Run, finish, runner
from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3, inverse, pose, random_direction, rotation_angle
from stages.hand_eye.board import Board
from stages.hand_eye.rig import Rig
from stages.messages import CameraCalibration, Snapshot
from stages.robots import read_robot
from stages.robots.writing import with_camera

ROBOTS = Path(__file__).parents[2] / "stages" / "robots"
CASES = {"eye to hand": "fetch", "eye in hand": "ur5e_hand"}
"""Descriptions by what they show."""
SHIFT, TURN = 0.02, np.deg2rad(3)
"""Metres and radians by which the description is wrong, along and about a random axis each."""
WITHIN = 2e-3, np.deg2rad(0.2)


@dataclass(frozen=True)
class Result:
    """One calibration, and how far its result is from the truth: metres and radians."""

    case: str
    seed: int
    found: CameraCalibration
    before: tuple[float, float]
    after: tuple[float, float]
    """Of the camera in the description, as it was and as it was written."""
    seconds: float

    @property
    def good(self) -> bool:
        """Found, and within what is promised."""
        return self.found.success and all(error < limit for error, limit in zip(self.after, WITHIN, strict=True))


def calibrate(case: str, seed: int, settings: Sequence[str] = ()) -> Result:
    """Runs ``runner calibrate`` for a robot whose description is wrong, in a folder of its own."""
    model = ROBOTS / f"{CASES[case]}.yaml"
    rng = np.random.default_rng([seed, 6])
    X = Rig(read_robot(model), Board()).X
    wrong = X @ pose(exp_so3(TURN * random_direction(rng)), SHIFT * random_direction(rng))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        own = folder / "own.yaml"
        with_camera(model, own, read_robot(model).camera.link, wrong, "by guess")
        begun = time.monotonic()
        run = _run(folder, f"world.robot={model}", f"calibrator.robot={own}", f"world.seed={seed}", *settings)
        seconds = time.monotonic() - begun
        (found,) = run.messages(CameraCalibration)
        errors = run.messages(Snapshot)[0].errors
        assert errors is not None  # Every simulated camera is off.
        truth = X @ errors.T_believed_true
        read_robot.cache_clear()
        written = Rig(read_robot(own), Board()).X
    return Result(case, seed, found, _apart(truth, wrong), _apart(truth, written), seconds)


def _run(folder: Path, *settings: str) -> Run:
    changes = [part for setting in settings for part in ("--set", setting)]
    return finish(runner("calibrate", "--recordings", str(folder), *changes), folder)


def _apart(one: Floats, other: Floats) -> tuple[float, float]:
    T = inverse(one) @ other
    return float(np.linalg.norm(T[:3, 3])), float(rotation_angle(T[:3, :3], np.eye(3)))


HEADER = (
    "| case | seed | boards | residual | left out (median) | error before | error after | wall time |\n"
    "|---|---|---|---|---|---|---|---|"
)


def row(result: Result) -> str:
    """One line of the table."""
    found = result.found
    if not found.success:
        return f"| {result.case} | {result.seed} | refused: {found.reason} | | | | | {result.seconds:.0f} s |"
    out = float(np.median(found.left_out_metres)), float(np.median(found.left_out_radians))
    cells = (
        result.case, result.seed, len(found.residuals), f"{found.residual:.2f} px", _said(out), _said(result.before),
        _said(result.after), f"{result.seconds:.0f} s",
    )  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |"


def _said(error: tuple[float, float]) -> str:
    return f"{1e3 * error[0]:.2f} mm, {np.rad2deg(error[1]):.3f} degrees"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", type=int, nargs="+", metavar="SEED")
    parser.add_argument("--case", choices=CASES, action="append", dest="cases", help="only this one")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE", dest="settings")
    options = parser.parse_args()
    print(HEADER, flush=True)
    results: list[Result] = []
    for case in options.cases or CASES:
        for seed in options.seeds:
            results.append(calibrate(case, seed, options.settings))
            print(row(results[-1]), flush=True)
    good = sum(result.good for result in results)
    print(f"{good} of {len(results)} within {1e3 * WITHIN[0]:g} mm and {np.rad2deg(WITHIN[1]):g} degrees")
    return 0 if good == len(results) else 1


if __name__ == "__main__":
    sys.exit(main())
