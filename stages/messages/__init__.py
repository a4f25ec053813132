"""Every type that crosses a process boundary.

Units are SI (metres, radians, seconds) unless a name says otherwise. ``T_a_b`` maps coordinates of frame
``b`` to frame ``a``: ``p_a = T_a_b @ p_b``. Frames: ``base`` the robot's base_link (x forward, z up),
``camera`` the optical frame (x right, y down, z forward; pixel centres at integer coordinates), ``table``
the support plane (z up, z = 0 on the surface), ``object`` as the catalogue defines it.
"""

from stages.messages.arrays import Box, Depth, Intrinsics, Mask, Points, Pose, Poses, Rgb, Vector
from stages.messages.correction import Arrived, Calibrate, Correction, PostureRequest
from stages.messages.digest import Candidate, Candidates, Hypothesis, Observation, Posterior, SceneEstimate
from stages.messages.goals import Add, Face, Forget, Kept, Loosen, Rename, Strike
from stages.messages.hand_eye import Abort, CalibrateCamera, CameraCalibration, Mounting
from stages.messages.robot import Brake, RobotCommand, RobotState
from stages.messages.ros2 import Asked, Ros2Heard, Ros2Message, Ros2Sent
from stages.messages.scene import Assertion, ObjectPose, SceneGraph, VirtualObject
from stages.messages.sensing import Frame, LookRequest, SensorErrors, Snapshot
from stages.messages.task import (
    Answer,
    Arrange,
    Arrangement,
    Go,
    Goal,
    Halt,
    Look,
    Move,
    Outcome,
    Pause,
    Plan,
    Question,
    Recover,
    Restore,
    Stop,
    Task,
    Teach,
    Transfer,
    TransferRequest,
    Verdict,
)

__all__ = [
    "Abort",
    "Add",
    "Answer",
    "Arrange",
    "Arrangement",
    "Arrived",
    "Asked",
    "Assertion",
    "Box",
    "Brake",
    "Calibrate",
    "CalibrateCamera",
    "CameraCalibration",
    "Candidate",
    "Candidates",
    "Correction",
    "Depth",
    "Face",
    "Forget",
    "Frame",
    "Go",
    "Goal",
    "Halt",
    "Hypothesis",
    "Intrinsics",
    "Kept",
    "Look",
    "LookRequest",
    "Loosen",
    "Mask",
    "Mounting",
    "Move",
    "ObjectPose",
    "Observation",
    "Outcome",
    "Pause",
    "Plan",
    "Points",
    "Pose",
    "Poses",
    "Posterior",
    "PostureRequest",
    "Question",
    "Recover",
    "Rename",
    "Restore",
    "Rgb",
    "RobotCommand",
    "RobotState",
    "Ros2Heard",
    "Ros2Message",
    "Ros2Sent",
    "SceneEstimate",
    "SceneGraph",
    "SensorErrors",
    "Snapshot",
    "Stop",
    "Strike",
    "Task",
    "Teach",
    "Transfer",
    "TransferRequest",
    "Vector",
    "Verdict",
    "VirtualObject",
]
