"""Competitors of the estimator by name, run on the same preprocessed images, boxes and catalogue."""

from __future__ import annotations

from benchmarks.comparison.baselines import fpfh, icp, perch, ppf, random_guess
from benchmarks.comparison.baselines.common import Estimator

METHODS: dict[str, Estimator] = {
    "icp": icp.estimate,
    "fpfh": fpfh.estimate,
    "ppf": ppf.estimate,
    "perch": perch.estimate,
    "random": random_guess.estimate,
}
