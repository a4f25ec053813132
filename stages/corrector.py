"""Looks through, taken from where they are wanted, and corrected by what the arm showed of its camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from runner.contract import Context, Refused, Stage
from stages.geometry.arrays import Floats
from stages.messages import Arrived, Calibrate, Correction, Frame, LookRequest, PostureRequest
from stages.messages.correction import CAMERAS_WAY, OWN_ARM
from stages.messages.task import STANDS
from stages.perception.correction.body import RobotSurface
from stages.perception.correction.occupied import occupied
from stages.perception.correction.registration import Posture, Registration, Sight
from stages.perception.rendering.rasteriser import View
from stages.robots import BUILT_IN, read_robot

if TYPE_CHECKING:
    from stages.perception.correction.registration import Fit

_CANDIDATES = 20
"""Postures among which the most telling ones are chosen."""
_FEWEST = 2
"""Postures without which nothing is said of the camera."""
_SURVEYS = 2
"""Further looks at what is in the way, from which other postures are chosen where too few were reached."""
_MORE_WAYS = 2
"""Ways home that are tried where none was found or one was barred: an arm in view hides what is to be seen."""
_SURVEY = f"{OWN_ARM}: what is in the way"
_HAND_CAMERA = (
    "the camera is in the hand and does not see how it is held: its pose in the hand has to be measured with a board"
)
_NOWHERE = "nobody knows where the camera stands to the robot"
_NO_TABLE = "no table is seen where the robot works"


class Phase(Enum):
    """What the corrector waits for."""

    IDLE = "a look request"
    SURVEYING = "a look at what is in the way"
    MOVING = "the arm"
    LOOKING = "a look at the arm"
    HOMING = "the arm to come home"
    SCOUTING = "a look at what is in the way of the camera"
    TURNING = "the camera to get where it looks from"


@dataclass(frozen=True, slots=True)
class State:
    """Where the correction stands; every handler replaces it as a whole."""

    phase: Phase = Phase.IDLE
    due: bool = True
    """The arm shows itself before the next look."""
    asked: LookRequest | None = None
    """The look that waits for the arm."""
    view: int | None = 0
    """From where the camera looks, as in :attr:`LookRequest.view`; None where it did not get there."""
    ahead: tuple[PostureRequest, ...] = ()
    """Postures that are left to try, the most telling first."""
    at: Arrived | None = None
    pixels: View | None = None
    """Those of the depth camera."""
    sights: tuple[Sight, ...] = ()
    robot_seconds: float = 0.0
    surveys: int = 0
    """Times that what is in the way was looked at again."""
    correction: Correction | None = None
    """That of the looks."""


class Corrector(Stage):
    """Passes looks on and corrects what comes of them by what the robot's own arm showed.

    Before the first look, and when somebody asks for it, the arm goes to a few postures over the table; its surface,
    which description and encoders give, is registered to what the depth camera reads of it. What is found holds until
    it is asked for again.

    A look from another of the robot's views waits until the arm has brought the camera there, around what is seen from
    where it is now. Where the arm does not get there, the look is from where it stands.
    """

    stateful = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """``calibrate: false`` passes everything on as it is."""

        robot: Path = BUILT_IN
        calibrate: bool = True
        postures: int = 4
        """In which the arm shows itself."""
        translation: float = 0.005
        """Metres along each axis by which the camera may not be where it is said to be, a standard deviation as well as
        those that follow."""
        degrees: float = 0.5
        """About each axis, the same; with what the depth camera is turned against the colour camera."""
        depth: float = 0.02
        """Share by which readings may be too long or too short."""

        def __post_init__(self) -> None:
            if self.postures < _FEWEST:
                raise Refused(f"corrector.postures={self.postures}: must be {_FEWEST} or more")
            for name in ("translation", "degrees", "depth"):
                if not getattr(self, name) > 0:
                    raise Refused(f"corrector.{name}={getattr(self, name)}: must be above 0")

        @property
        def prior(self) -> Floats:
            """Standard deviations of rotation, translation and depth factor, 7."""
            return np.array([*[np.deg2rad(self.degrees)] * 3, *[self.translation] * 3, self.depth])

    @classmethod
    def prepare(cls, config: Config) -> None:
        """Reads the robot's shapes and loads the kernel."""
        cls(config)

    def __init__(self, config: Config) -> None:
        self._config = config
        self._robot = read_robot(config.robot)
        self._state = State(due=config.calibrate)
        if config.calibrate:
            # Motion planning takes half a second to load; whoever only reads a graph does without.
            from stages.planning.motion.motion import warm_up

            warm_up(self._robot)
            self._surface = RobotSurface(self._robot)
            self._surface.seen((), np.zeros(0), np.eye(4), View(1.0, 1.0, 0.0, 0.0, 4, 4))  # loads the kernel

    def on_calibrate(self, calibrate: Calibrate, ctx: Context) -> None:
        """Has the arm show itself before the next look."""
        if not self._config.calibrate:
            raise Refused("corrector.calibrate is false")
        if self._robot.camera_in_hand:
            raise Refused(_HAND_CAMERA)
        if self._state.phase is not Phase.IDLE:
            raise Refused(f"under way: waits for {self._state.phase.value}")
        self._state = replace(self._state, due=True)
        ctx.log("the arm shows itself before the next look")

    def on_look_request(self, look_request: LookRequest, ctx: Context) -> Iterator[LookRequest | Correction]:
        """Passes the request on, once the arm has shown itself and the camera is where it is wanted."""
        if not self._state.due:
            yield self._from_its_view(look_request)
            return
        self._state = State(phase=Phase.SURVEYING, asked=look_request, view=self._state.view)
        if self._robot.camera_in_hand:
            yield from self._given_up(_HAND_CAMERA, ctx)
        else:
            yield LookRequest(purpose=_SURVEY)

    def on_frame(self, frame: Frame, ctx: Context) -> Iterator[Frame | PostureRequest | LookRequest | Correction]:
        """Corrects a look that somebody asked for, and takes those at the arm."""
        state = self._state
        if state.phase is Phase.SURVEYING:
            yield from self._survey(frame, ctx)
        elif state.phase is Phase.LOOKING:
            assert state.at is not None and frame.T_base_camera is not None  # The survey has seen to that.
            posture = Posture(state.at.joint_names, state.at.positions, frame.T_base_camera)
            self._state = replace(state, sights=(*state.sights, Sight(posture, frame.depth)))
            yield self._next()
        elif state.phase is Phase.SCOUTING:
            yield self._turned(frame, ctx)
        else:
            yield _corrected(frame, state.correction)

    def on_arrived(self, arrived: Arrived, ctx: Context) -> Iterator[PostureRequest | LookRequest | Correction]:
        """Looks at the arm, or goes on where it did not get there; after a touch it goes home."""
        state = self._state = replace(self._state, robot_seconds=self._state.robot_seconds + arrived.robot_seconds)
        if arrived.stopped in STANDS:
            # What was asked for falls away; an arm that was showing itself does so again before the next look.
            turning = state.phase is Phase.TURNING
            self._state = replace(state, phase=Phase.IDLE, asked=None, view=None) if turning else State()
        elif state.phase is Phase.TURNING:
            yield self._looked(arrived.success)
        elif state.phase is Phase.HOMING and (arrived.success or not state.ahead):
            self._state = replace(state, view=0 if arrived.success else None)
            yield from self._concluded(ctx)
        elif state.phase is Phase.HOMING:
            self._state = replace(state, ahead=state.ahead[1:])
            yield state.ahead[0]
        elif arrived.success:
            self._state = replace(state, phase=Phase.LOOKING, at=arrived)
            number = len(state.sights) + 1
            yield LookRequest(purpose=f"{OWN_ARM}, posture {number} of {self._config.postures}")
        else:
            self._state = replace(state, ahead=state.ahead[-1:] if arrived.stopped else state.ahead)
            yield self._next()

    def _survey(self, frame: Frame, ctx: Context) -> Iterator[PostureRequest | LookRequest | Correction]:
        """Chooses postures around what is in the way."""
        if frame.T_base_camera is None:
            yield from self._given_up(_NOWHERE, ctx)
            return
        seen = self._in_the_way(frame, ctx)
        if seen is None:
            yield from self._given_up(_NO_TABLE, ctx)
            return
        view = _view_of(frame)
        self._state = replace(self._state, pixels=view, ahead=tuple(self._proposed(*seen, view, ctx)))
        yield self._next()

    def _in_the_way(self, frame: Frame, ctx: Context) -> tuple[float, Floats] | None:
        """The table's height at most and boxes around what stands on it; None where no table is seen."""
        assert frame.T_base_camera is not None  # Who asks has seen to that.
        readings = frame.depth if frame.robot_mask is None else np.where(frame.robot_mask, 0, frame.depth)
        return occupied(readings.astype(np.float32), _view_of(frame), frame.T_base_camera, self._robot, ctx.rng)

    def _from_its_view(self, asked: LookRequest) -> LookRequest:
        """The look; where the camera has to go elsewhere for it, first one at what is in the way."""
        if asked.view == self._state.view:
            return asked
        if asked.view > len(self._robot.views):
            there_are = f"{self._config.robot} has {len(self._robot.views)}"
            raise Refused(f"view {asked.view}: {there_are}; demonstrator.robot must be the same")
        self._state = replace(self._state, phase=Phase.SCOUTING, asked=asked)
        return LookRequest(purpose=CAMERAS_WAY)

    def _turned(self, frame: Frame, ctx: Context) -> PostureRequest | LookRequest:
        """Has the camera brought to where it is wanted."""
        asked = self._state.asked
        assert asked is not None
        if frame.T_base_camera is None:
            return self._stays(_NOWHERE, ctx)
        seen = self._in_the_way(_corrected(frame, self._state.correction), ctx)
        if seen is None:
            return self._stays(_NO_TABLE, ctx)
        self._state = replace(self._state, phase=Phase.TURNING)
        height, boxes = seen
        return PostureRequest(
            joint_names=self._robot.joints,
            positions=(self._robot.home, *self._robot.views)[asked.view],
            table_height=height,
            occupied=boxes,
            label=f"look from view {asked.view}" if asked.view else "look from home",
        )

    def _stays(self, why: str, ctx: Context) -> LookRequest:
        """The look that was asked for, from where the camera is."""
        ctx.log(f"{why}; the camera stays where it is", level="warning")
        return self._looked(False)

    def _looked(self, there: bool) -> LookRequest:
        """The look that was asked for, from where the camera is now."""
        asked = self._state.asked
        assert asked is not None
        self._state = replace(self._state, phase=Phase.IDLE, asked=None, view=asked.view if there else None)
        return asked

    def _proposed(self, height: float, boxes: Floats, view: View, ctx: Context) -> Iterator[PostureRequest]:
        from stages.planning.motion.posture import postures_in_view, world_of

        robot = self._robot
        home = PostureRequest(
            joint_names=robot.joints, positions=robot.home, table_height=height, occupied=boxes, label="go home"
        )
        found = list(postures_in_view(world_of(robot, home), ctx.rng, _CANDIDATES))
        candidates = [self._posture(q) for q in found]
        for number, k in enumerate(Registration(self._surface, view, self._config.prior).telling(candidates), 1):
            yield msgspec.structs.replace(home, positions=found[k], label=f"show the arm, posture {number}")
        yield home

    def _posture(self, q: Floats) -> Posture:
        """The robot with its arm at joint positions ``q`` (J), its hand open and everything else as at home."""
        robot = self._robot
        positions = dict(zip(robot.joints, q.tolist(), strict=True))
        positions |= robot.still | robot.gripper.posture(robot.gripper.open_width)
        names, values = tuple(positions), np.array(list(positions.values()))
        return Posture(names, values, robot.camera_pose(names, values))

    def _next(self) -> PostureRequest:
        """To the next posture; home after the last."""
        state = self._state
        *ahead, home = state.ahead
        if len(state.sights) == self._config.postures or not ahead:
            self._state = replace(state, phase=Phase.HOMING, ahead=(home,) * _MORE_WAYS)
            return home
        self._state = replace(state, phase=Phase.MOVING, ahead=(*ahead[1:], home))
        return ahead[0]

    def _concluded(self, ctx: Context) -> Iterator[LookRequest | Correction]:
        state = self._state
        if len(state.sights) < _FEWEST:
            few = f"the arm could show itself in {len(state.sights)} postures only"
            if state.view is not None and state.surveys < _SURVEYS:
                ctx.log(f"{few}; looks again at what is in the way", level="warning")
                self._state = replace(state, phase=Phase.SURVEYING, surveys=state.surveys + 1)
                yield LookRequest(purpose=_SURVEY)
            else:
                yield from self._given_up(few, ctx)
            return
        assert state.pixels is not None
        fit = Registration(self._surface, state.pixels, self._config.prior).fit(state.sights)
        yield from self._settled(self._correction(fit), ctx)

    def _correction(self, fit: Fit) -> Correction:
        return Correction(
            found=not fit.doubt,
            reason=fit.doubt,
            T_believed_true=fit.T_believed_true,
            depth=fit.depth,
            deviations=fit.deviations,
            residual=fit.residual,
            explained=fit.explained,
            postures=len(self._state.sights),
            robot_seconds=self._state.robot_seconds,
        )

    def _given_up(self, reason: str, ctx: Context) -> Iterator[LookRequest | Correction]:
        none = Correction(
            found=False, reason=reason, T_believed_true=np.eye(4), depth=1.0, deviations=self._config.prior,
            residual=0.0, explained=0.0, postures=len(self._state.sights), robot_seconds=self._state.robot_seconds,
        )  # fmt: skip
        yield from self._settled(none, ctx)

    def _settled(self, correction: Correction, ctx: Context) -> Iterator[LookRequest | Correction]:
        """Keeps the correction, says it, and takes the look that was asked for."""
        asked = self._state.asked
        assert asked is not None
        self._state = State(due=False, correction=correction, view=self._state.view)
        ctx.log(told(correction), level="info" if correction.found else "warning")
        yield correction
        yield self._from_its_view(asked)


def told(correction: Correction) -> str:
    """A correction in one line."""
    if not correction.found:
        return f"the camera is taken as it is: {correction.reason}"
    T = correction.T_believed_true
    turn = np.rad2deg(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
    return (
        f"the arm in {correction.postures} postures shows: the depth camera stands "
        f"{1e3 * np.linalg.norm(T[:3, 3]):.1f} mm and {turn:.2f} degrees off, its readings are "
        f"{100 * (1 / correction.depth - 1):+.2f} % off; {1e3 * correction.residual:.1f} mm remain"
    )


def _view_of(frame: Frame) -> View:
    return View.of(frame.K, frame.depth.shape[1], frame.depth.shape[0])


def _corrected(frame: Frame, correction: Correction | None) -> Frame:
    if correction is None or not correction.found or frame.T_base_camera is None:
        return frame
    return msgspec.structs.replace(
        frame,
        depth=frame.depth * np.float32(correction.depth),
        T_base_camera=frame.T_base_camera @ correction.T_believed_true,
    )
