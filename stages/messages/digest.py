"""DIGEST: from candidate boxes to the ranked scene (paper, section IV-A)."""

from runner.contract import Message, Part, Struct
from stages.messages.arrays import Box, Depth, Intrinsics, Mask, Matrix, Pose, Rgb, Vector
from stages.messages.scene import ObjectPose, UnknownRegion


class Candidate(Struct, frozen=True, kw_only=True):
    """C_i of equation 1: a box, its most confident label and that confidence."""

    box: Box
    label: str
    confidence: float


class Candidates(Message, frozen=True, kw_only=True):
    """All m candidates of a frame; ``confidences[i, j]`` is v(L_j | B_i) for ``labels[j]``."""

    candidates: tuple[Candidate, ...]
    labels: tuple[str, ...]
    confidences: Matrix


class Observation(Message, frozen=True, kw_only=True):
    """The preprocessed point cloud as a depth image, with its support plane removed and named."""

    depth: Depth
    """Metres; 0 where there is no reading, where the robot is or outside the working area."""
    rgb: Rgb
    foreground: Mask
    """True where a reading stands above the support plane."""
    K: Intrinsics
    T_camera_table: Pose
    T_base_camera: Pose | None
    scene_id: int = 0
    image_id: int = 0
    name: str = ""


class Hypothesis(Part, frozen=True, kw_only=True):
    """H_i: one combination of N_c candidates, most confident first (equation 2)."""

    candidates: tuple[Candidate, ...]
    left_out: int = 0
    """Combinations of the frame that the cap left out."""


class ParticleTrace(Struct, frozen=True, kw_only=True):
    """How the filter of one object converged, thinned for people to look at."""

    iterations: tuple[int, ...]
    costs: Vector
    """Best cost per kept iteration."""
    positions: Matrix
    """Particle positions of the kept iterations in the camera frame, one row ``[iteration, x, y, z]`` each."""


class Posterior(Part, frozen=True, kw_only=True):
    """What the particle filter made of one hypothesis: its most likely scene and that scene's weight."""

    objects: tuple[ObjectPose, ...]
    log_weight: float
    """Logarithm of the unnormalised weight w* of the best particle (equations 8 and 10)."""
    traces: tuple[ParticleTrace, ...] = ()
    left_out: int = 0
    """Combinations of the frame that the cap left out."""


class SceneEstimate(Message, frozen=True, kw_only=True):
    """The maximal likely scene and the weights of all hypotheses of its frame."""

    objects: tuple[ObjectPose, ...]
    winner: int
    log_weights: Vector
    left_out: int
    T_camera_table: Pose
    T_base_camera: Pose | None
    K: Intrinsics
    scene_id: int = 0
    image_id: int = 0
    name: str = ""
    probabilities: Vector | None = None
    """Of each hypothesis, summing to 1: ``log_weights`` after calibration; None where they were not judged."""
    unknown: tuple[UnknownRegion, ...] = ()
    """What no object explains, the largest first."""
