"""How far fields may be from a recording that was made on another processor or with other libraries.

On the same ones every byte must be equal and this table is not used. A field that is not listed is compared exactly:
labels, counts, indices, relations and decisions hold on every machine. A step is executed from recorded inputs, so
that what is allowed here is what one stage may add.
"""

from __future__ import annotations

import math

from runner.contract import Tolerance

PIXELS = Tolerance(0.5)
SHARE = Tolerance(0.01)
"""Confidences and visible shares, which lie between 0 and 1."""
PROBABILITY = Tolerance(0.01)
POSE = Tolerance(1e-3)
"""Metres, and entries of a rotation (0.06 degrees): a filter that rounds otherwise takes another way there."""
PLANE = Tolerance(1e-6)
"""Poses that one formula gives, with no search in between."""
COST = Tolerance(1e-4)
"""Of a likelihood, metres per pixel of an object."""
WEIGHT = Tolerance(0.1)
"""Logarithms of unnormalised weights."""
IMAGE = Tolerance(share=1e-3)
"""A reading at a threshold falls on the other side."""
SHOWN = Tolerance(math.inf)
"""How a filter came to its result, and where it starts: of symmetric poses another one may come first. And the corners
of a hull, of which there may be one more or less."""

TOLERANCES = {
    "Candidate.box": PIXELS,
    "Candidate.confidence": SHARE,
    "Candidates.confidences": SHARE,
    "Observation.depth": IMAGE,
    "Observation.foreground": IMAGE,
    "Observation.T_camera_table": PLANE,
    "Observation.support": SHOWN,
    "Observation.beyond": IMAGE,
    "ParticleTrace.iterations": SHOWN,
    "ParticleTrace.costs": SHOWN,
    "ParticleTrace.positions": SHOWN,
    "LonePose.T_camera_object": SHOWN,
    "DepthPatch.left": SHOWN,
    "DepthPatch.top": SHOWN,
    "DepthPatch.inverse": SHOWN,
    "DepthPatch.change": SHOWN,
    "Placed.T_camera_object": POSE,
    "Posterior.log_weight": WEIGHT,
    "Posterior.charges": WEIGHT,
    "Posterior.unexplained": SHARE,
    "Contender.log_weight": WEIGHT,
    "SceneEstimate.log_weights": WEIGHT,
    "SceneEstimate.probabilities": PROBABILITY,
    "SceneEstimate.T_camera_table": PLANE,
    "ObjectPose.T_camera_object": POSE,
    "ObjectPose.confidence": SHARE,
    "ObjectPose.cost": COST,
    "ObjectPose.box": PIXELS,
    "ObjectPose.visible": SHARE,
    "ObjectPose.probability": Tolerance(0.05),
    "ObjectPose.spread_metres": POSE,
    # Of a few poses that are polished; on another processor one of them may end elsewhere.
    "ObjectPose.spread_radians": Tolerance(0.1),
    "ObjectPose.looked_through": SHARE,
    "ObjectPose.facing": PROBABILITY,
    "Alternative.T_camera_object": POSE,
    "Alternative.probability": Tolerance(0.05),
    "UnknownRegion.box": Tolerance(2.0),
    "UnknownRegion.points": Tolerance(20.0),
    "UnknownRegion.centre_table": POSE,
    "UnknownRegion.extent_table": POSE,
    "Doubt.T_base_other": PLANE,
    "SceneObject.T_base_object": PLANE,
    "SceneGraph.T_base_table": PLANE,
    "VirtualObject.T_parent_virtual": PLANE,
    "VirtualObject.radius": PLANE,
    "Transfer.T_base_targets": PLANE,
}
"""By ``Type.field`` of the message or struct that declares the field."""
