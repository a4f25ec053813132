"""A truth that is exact fits the readings; one that was moved does not, and ICP turns it back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.common.datasets import detections_file, images
from benchmarks.comparison.accuracy import score
from benchmarks.comparison.truth import comparisons, line, summary
from stages.devices.bop_results import Result
from stages.devices.clutter import write_clutter
from stages.geometry.poses import exp_so3, pose
from tests.stages.perception.scenes import CATALOGUE


def test_a_wrong_truth_fits_worse_and_is_turned(tmp_path: Path) -> None:
    write_clutter(tmp_path, CATALOGUE, scenes=1, seed=7)
    (image,) = images(tmp_path, detections_file(tmp_path, "exact"))
    exact = [Result(*truth.image, truth.label, 1.0, truth.T_camera_object, 0.5) for truth in image.truths]
    tilt = pose(exp_so3(np.array([0.0, 0.1, 0.0])), np.zeros(3))
    moved = tuple(replace(truth, T_camera_object=truth.T_camera_object @ tilt) for truth in image.truths)
    right = list(comparisons(image, score(image.truths, exact, CATALOGUE), CATALOGUE, 6))
    wrong = list(comparisons(image, score(moved, exact, CATALOGUE), CATALOGUE, 6))
    assert all(each.at_truth == pytest.approx(each.at_estimate) for each in right)
    assert np.median([each.turned for each in right]) < np.deg2rad(1)
    assert np.median([each.at_truth - each.at_estimate for each in wrong]) > 0.0003
    assert np.median([each.turned for each in wrong]) > np.deg2rad(2)
    assert line(wrong[0], "cup").startswith("| 1 | cup | ") and f"of {len(wrong)}" in summary(wrong)
