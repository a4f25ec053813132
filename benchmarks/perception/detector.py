"""Accuracy and speed of the trained detector: ``python -m benchmarks.detector EXAMPLES.npz...``."""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from stages.perception.detection.trained.evaluation import Evaluation, evaluate
from stages.perception.detection.trained.network import DetectionNetwork, detect
from stages.perception.detection.trained.training_images import Example, load_examples


def print_evaluation(title: str, evaluation: Evaluation) -> None:
    print(f"\n{title}: {evaluation.images} images, {evaluation.objects} objects")
    print(f"mAP50 {evaluation.mean_precision:.3f}")
    print("  ".join(f"{label} {value:.3f}" for label, value in evaluation.precision.items()))
    print("threshold  recall  images with every object  false boxes per image")
    for point in evaluation.points:
        print(f"{point.threshold:9.2f}{point.recall:8.3f}{point.complete:26.3f}{point.false_boxes:23.3f}")


def seconds_per_image(network: DetectionNetwork, examples: Sequence[Example]) -> float:
    """Median over 30 images of 640 x 480, one thread."""
    durations: list[float] = []
    for example in examples[:30]:
        image = cv2.resize(example.image, (640, 480)).astype(np.uint8)
        start = time.perf_counter()
        detect(network, image, threshold=0.3, keep=12)
        durations.append(time.perf_counter() - start)
    return float(np.median(durations))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("examples", type=Path, nargs="+", help="npz files of stages.devices.detector_data")
    parser.add_argument("--weights", type=Path, default=Path("stages/perception/detector.safetensors"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    network = DetectionNetwork.load(arguments.weights)
    for path in arguments.examples:
        examples, _ = load_examples(path)
        print_evaluation(path.name, evaluate(network, examples))
        print(f"{1e3 * seconds_per_image(network, examples):.0f} ms per 640 x 480 image on one core")


if __name__ == "__main__":
    main()
