"""DIGEST: from candidate boxes to the ranked scene (paper, section IV-A)."""

from runner.contract import Message, Part, Struct
from stages.messages.arrays import Box, Depth, Intrinsics, Mask, Matrix, Pose, Rgb, Vector
from stages.messages.scene import ObjectPose, UnknownRegion


class Candidate(Struct, frozen=True, kw_only=True):
    """C_i of equation 1: a box, its most confident label and that confidence."""

    box: Box
    label: str
    confidence: float
    others: tuple[str, ...] = ()
    """Labels that it may have instead, the likeliest first, where the detector is in doubt."""


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
    support: Matrix | None = None
    """K x 2, metres: corners of the support surface as far as it was seen, in the table's frame, counter-clockwise."""
    unusable: str = ""
    """Why nothing is to be seen in the frame, in words: then there is no reading, and the plane is no real one."""
    beyond: Depth | None = None
    """Metres outside the working area; 0 in it, where there is no reading and where the robot is. None in recordings
    that were made before the field was."""


class ParticleTrace(Struct, frozen=True, kw_only=True):
    """How the filter of one object converged, thinned for people to look at."""

    iterations: tuple[int, ...]
    costs: Vector
    """Best cost per kept iteration."""
    positions: Matrix
    """Particle positions of the kept iterations in the camera frame, one row ``[iteration, x, y, z]`` each."""


class LoneCandidate(Part, frozen=True, kw_only=True):
    """C_i by itself: to be looked at alone, once for all hypotheses that it is part of."""

    known_as = "Prospect"
    candidate: Candidate | None
    """None in the one part of a frame without candidates."""
    n_objects: int | None
    """N_c of the frame; None where it is not known."""


class LonePose(Struct, frozen=True, kw_only=True):
    """Where a candidate's object stands if it is the only one on the table."""

    T_camera_object: Pose
    trace: ParticleTrace
    rise: float = 0.03
    """Metres by which what it shows stands out of the plane, on average, along the ray and bounded; asked for where N_c
    is not known."""
    claim: float = 0.0
    """What the readings that it covers cost if nothing explains them, metres times pixels; asked for likewise."""
    explained: float = 0.0
    """Share of its claim that it explains; asked for likewise."""


PATCH_STRIDE = 2
"""Patches keep every second pixel of every second row."""


class DepthPatch(Struct, frozen=True, kw_only=True):
    """What a candidate's object shows at its start: every second pixel of the rectangle about it."""

    left: int
    top: int
    """First column and row, in kept pixels."""
    inverse: Depth
    """Inverse depth of the object, 1/metres; 0 beside it."""
    change: Depth
    """What the cost of the scene changes by where the object is in sight, metres."""


class LoneEstimate(Part, frozen=True, kw_only=True):
    """What the look at one candidate alone found; nothing in the paper's plain form, which takes none."""

    known_as = "Sighting"
    n_objects: int | None
    candidate: Candidate | None = None
    """What was looked at; None in the one part of a frame without candidates."""
    share: float = 0.1
    """With N_c unknown the object must explain so much of what it claims: a tenth, or what an appraisal asks for."""
    start: LonePose | None = None
    glimpse: DepthPatch | None = None


class Offer(Struct, frozen=True, kw_only=True):
    """A candidate that may be part of the scene, whichever hypothesis leaves it out."""

    candidate: Candidate
    share: float
    """Of what it claims that its object must explain."""
    instead: bool = False
    """Whether this is one of several labels of a box, and less likely than another or no likelier."""


class Contender(Part, frozen=True, kw_only=True):
    """A hypothesis that was estimated, for the ranking of all of them."""

    objects: tuple[ObjectPose, ...]
    log_weight: float
    left_out: int = 0
    lambda_r: float = 1.0


class Search(Struct, frozen=True, kw_only=True):
    """What the search over scenes knows when it begins a round; the first part of the round carries it."""

    offers: tuple[Offer, ...]
    earlier: tuple[Contender, ...] = ()
    """The hypotheses of the rounds before."""
    rounds: int = 0
    """How many these are."""
    unexplained: tuple[float, ...] = ()
    """Of each offer's box what the scene that the round revises leaves unexplained."""
    suggestions: bool = False
    """Whether posteriors also say what their scenes suggest."""


class Placed(Struct, frozen=True, kw_only=True):
    """A candidate's object at a pose."""

    candidate: Candidate
    T_camera_object: Pose


class Hypothesis(Part, frozen=True, kw_only=True):
    """H_i: one combination of N_c candidates, most confident first (equation 2)."""

    candidates: tuple[Candidate, ...]
    left_out: int = 0
    """Combinations of the frame that the cap left out."""
    starts: tuple[LonePose, ...] = ()
    """Of each candidate, where there were looks at each alone. In later rounds the last candidates have none: they are
    looked for among the others, in this order."""
    charges: tuple[float, ...] = ()
    """What each object with a start costs by being there, metres times pixels, where N_c is not known."""
    shares: tuple[float, ...] = ()
    """Of what those without a start claim that they must explain."""
    search: Search | None = None
    """None where N_c is known: nothing is revised. In other parts than the first it knows the offers only."""
    incumbent: tuple[Placed, ...] = ()
    """A scene that is known: hypotheses all of whose scenes cost more are dropped."""
    charged: float = 0.0
    """What its objects cost by being there, metres times pixels; 0 where N_c is known."""
    incumbent_charged: float = 0.0
    """Likewise of the incumbent's."""


class Posterior(Part, frozen=True, kw_only=True):
    """What the particle filter made of one hypothesis: its most likely scene and that scene's weight."""

    objects: tuple[ObjectPose, ...]
    log_weight: float
    """Logarithm of the unnormalised weight w* of the best particle (equations 8 and 10)."""
    traces: tuple[ParticleTrace, ...] = ()
    left_out: int = 0
    """Combinations of the frame that the cap left out."""
    dropped: bool = False
    """The hypothesis cannot win: ``log_weight`` is an upper bound, the objects stand where they start."""
    lambda_r: float = 1.0
    """Scale of the weight: ``log_weight`` is minus this times the cost, metres times pixels."""
    charges: tuple[float, ...] = ()
    """What each object costs by being there, metres times pixels, where N_c is not known."""
    unexplained: tuple[float, ...] = ()
    """Of every offer of the search: the share of what stands in its box that the scene does not explain."""
    suggested: tuple[Offer, ...] = ()
    """What no candidate shows and the scene suggests, where the search asks for it."""
    search: Search | None = None
    """The hypothesis's."""


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
    support: Matrix | None = None
    """K x 2, metres: corners of the support surface as far as it was seen, in the table's frame, counter-clockwise."""
    lambda_r: float = 1.0
    """Scale of the weights: each of ``log_weights`` is minus this times a cost, metres times pixels."""
    repeated: tuple[int, ...] = ()
    """Hypotheses that end in the same scene as a heavier one: they have no share in ``probabilities``."""
    contested: tuple[str, ...] = ()
    """Labels of which more is there than in the scene by the detector, which takes it for likely, and a hypothesis."""
    unusable: str = ""
    """The observation's: why nothing was to be seen; then that there are no objects says nothing of the scene."""
