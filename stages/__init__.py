"""What the robot does: perception, scene graphs, planning and execution as message-passing stages."""

import os

os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing is rendered with it: it need not look for a window system
