"""What each message of the graph looks like: images, meshes, particles, graphs and text."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from colorsys import hsv_to_rgb
from dataclasses import replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from runner.contract import Message
from runner.view.drawing import (
    BarChart,
    Boxes2D,
    Clear,
    Color,
    Column,
    DepthImage,
    Drawing,
    Graph,
    Image,
    Layout,
    Lines3D,
    Mesh3D,
    NextStep,
    Panel,
    Pinhole,
    Points3D,
    Row,
    Scalar,
    Tabs,
    Text,
    Transform,
)
from stages.geometry.arrays import Floats
from stages.geometry.camera import back_project
from stages.messages import (
    Arrange,
    Arrangement,
    CameraCalibration,
    Candidates,
    Frame,
    Goal,
    LookRequest,
    ObjectPose,
    Observation,
    Outcome,
    Plan,
    Posterior,
    Restore,
    RobotCommand,
    RobotState,
    SceneEstimate,
    SceneGraph,
    Snapshot,
    Teach,
    TransferRequest,
    Verdict,
)
from stages.messages.digest import ParticleTrace
from stages.messages.scene import UnknownRegion
from stages.perception.rendering.renderer import Camera, Item, Renderer
from stages.robots import BUILT_IN as ROBOT
from stages.robots import read_robot
from stages.scene.catalogue import Catalogue, Mesh
from stages.scene.doubts import SURE, UNSURE
from stages.scene.naming import region_name
from stages.scene.relations import TABLE
from stages.scene.text import support

if TYPE_CHECKING:  # only an export speaks with ROS 2
    from runner.view.ros2_bag import BagMessage
    from stages.devices.ros2.recorded import RecordedScenes
if TYPE_CHECKING:  # MuJoCo is loaded once there is a robot
    from stages.robots.body import Body

MOTION_FRAMES = 8
"""Postures shown of one robot motion."""
TABLE_SIZE = (0.7, 1.1)
"""Metres of support plane drawn around the objects, along x and y of the base."""
NODE_SPACING = (130.0, 110.0)
"""Pixels between the nodes of a scene graph, across and down."""
GHOST_TRIANGLES = 80
_NO_ROBOTS_TABLE = (0.8, 0.0, 0.7)
"""Where the middle of the table is taken to be in graphs that name no robot, metres."""
_GREY: Color = (128, 128, 128)
_BLUE: Color = (86, 156, 214)
_GREEN: Color = (106, 190, 120)
_ORANGE: Color = (230, 150, 70)
_RED: Color = (226, 82, 74)
_MAGENTA: Color = (214, 92, 200)
_GHOST: Color = (205, 210, 225)


class Views:
    """Draws messages; remembers frames and posteriors until their scene estimate comes."""

    def __init__(self, configs: Mapping[str, Mapping[str, Any]]) -> None:
        paths = [config["catalogue"] for config in configs.values() if "catalogue" in config]
        # A real camera is calibrated without knowing any objects.
        self._catalogue = Catalogue.load(Path(paths[0])) if paths else Catalogue({})
        self._colors = palette(list(self._catalogue.objects))
        self._configs = configs
        self._refined = configs.get("refiner", {}).get("form") == "default"
        """A better estimate follows the ranker's."""
        self._frames: dict[tuple[int, int, str], Frame] = {}
        self._posteriors: deque[Posterior] = deque(maxlen=512)
        robots = [Path(config["robot"]) for config in configs.values() if "robot" in config]
        self._robot_file = robots[0] if robots else ROBOT
        # Graphs without a robot need not have one installed.
        table = read_robot(self._robot_file).table if robots else None
        self._table = (*table.center, table.height) if table else _NO_ROBOTS_TABLE
        self._joints: dict[str, float] = {}
        self._renderers: dict[tuple[int, int], Renderer] = {}
        self._shown: dict[str, str] = {}
        """Objects whose meshes stand in the world, with their labels."""
        self._progress: list[str] = []

    def layout(self) -> Layout:
        """Images to the left, the world in the middle, what is known of it to the right; for 16:10."""
        images = Column(
            (
                Panel("Camera and candidates", "image", "camera"),
                Panel("Estimate over observation", "image", "estimate"),
                Panel("Depth", "image", "depth"),
            )
        )
        filters = Row(
            (
                Panel("Best cost over iterations", "series", "cost"),
                Tabs((Panel("Look", "text", "look"), Panel("Hypotheses: probability", "bars", "weights"))),
            )
        )
        world = Column(
            (
                Panel(
                    "World",
                    "space",
                    "world",
                    eye=self._from_table(0.8, -0.9, 0.75),
                    target=self._from_table(-0.25, 0.03, 0.15),
                ),
                filters,
            ),
            shares=(3, 1.2),
        )
        knowledge = Column(
            (
                Panel("Scene graph", "graph", "graph/scene"),
                Panel("Goal", "graph", "graph/goal"),
                Tabs((Panel("Progress", "text", "text/progress"), Panel("Plan", "text", "text/plan"))),
            ),
            shares=(1.2, 1.2, 1),
        )
        return Row((images, world, knowledge), shares=(1, 1.7, 1.1))

    def _from_table(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """A point seen from the middle of the table, in the base frame."""
        cx, cy, cz = self._table
        return cx + x, cy + y, cz + z

    def static(self) -> Iterable[Drawing]:
        """Nothing: even the robot is only there once it speaks."""
        return ()

    def draw(self, message: Message) -> Iterator[Drawing]:
        """What one message shows."""
        match message:
            case Frame():
                yield from self._frame(message)
            case Candidates():
                yield candidate_boxes(message, self._colors)
            case Observation():
                yield from observation_points(message)
            case Posterior():
                self._posteriors.append(message)
            case SceneEstimate():
                yield from self._estimate(message)
            case SceneGraph():
                yield from self._scene(message)
            case RobotState(joint_names=names, positions=positions):
                yield from self._robot(names, positions)
            case Snapshot(joint_names=names, joint_positions=positions):
                yield from self._robot(names, positions)
            case RobotCommand():
                yield from self._motion(message)
            case _:
                yield from self._task(message)

    def ros2(self, message: Message, time_ns: int) -> Iterator[BagMessage]:
        """What one message is in ROS 2: images and intrinsics, transforms, detections, markers, the scene graph."""
        return self._recorded.told(message, time_ns)

    @cached_property
    def _recorded(self) -> RecordedScenes:
        from stages.devices.ros2.recorded import RecordedScenes

        return RecordedScenes(self._catalogue, self._configs)

    def _task(self, message: Message) -> Iterator[Drawing]:
        if isinstance(message, Goal):
            yield scene_nodes("graph/goal", message.scene, self._catalogue)
        if isinstance(message, Plan):
            yield Text("text/plan", plan_text(message))
            yield from self._planned(message)
        if isinstance(message, Outcome) and message.success:
            yield Clear(f"world/plan/{message.object}")
        line = progress_line(message)
        if line:
            self._progress.append(line)
            yield Text("text/progress", "\n".join(f"- {item}" for item in self._progress))

    def _planned(self, plan: Plan) -> Iterator[Drawing]:
        """Ghosts of objects where the plan puts them."""
        yield Clear("world/plan")
        for transfer in plan.transfers:
            if label := self._shown.get(transfer.object):
                ghost = _swollen(self._catalogue[label].simplified(GHOST_TRIANGLES))
                strips = _edges(ghost, transfer.T_base_targets[0])
                yield Lines3D(f"world/plan/{transfer.object}", strips, _GHOST, radius=0.0006)

    def _frame(self, frame: Frame) -> Iterator[Drawing]:
        self._frames[frame.scene_id, frame.image_id, frame.name] = frame
        for key in list(self._frames)[:-64]:
            del self._frames[key]
        yield Clear("camera/candidates")
        yield Image("camera/rgb", frame.rgb)
        yield DepthImage("depth/image", frame.depth)
        if frame.T_base_camera is not None:
            height, width = frame.depth.shape
            yield Transform("world/camera", frame.T_base_camera)
            yield Pinhole("world/camera/frustum", frame.K, width, height)

    def _estimate(self, estimate: SceneEstimate) -> Iterator[Drawing]:
        """The ranker's estimate ends the animation of the particles; the refiner's, with its doubt, replaces it."""
        yield Transform("world/camera", base_from_camera(estimate))
        # The next image's frame may have come long before: what is shown of the last one goes now.
        yield from (Clear(path) for path in ("world/camera/doubt", "estimate/objects"))
        if estimate.probabilities is None:
            yield from self._convergence(estimate)
        else:
            yield NextStep()
        weights = estimate.log_weights - estimate.log_weights.min()
        yield BarChart(
            "weights/hypotheses", weights if estimate.probabilities is None else estimate.probabilities, _BLUE
        )
        yield Text("look", look_text(estimate))
        yield from doubt_drawings(estimate, self._catalogue)
        frame = self._frames.get((estimate.scene_id, estimate.image_id, estimate.name))
        if frame is not None and (estimate.probabilities is not None or not self._refined):
            yield Image("estimate/rgb", self._overlay(frame, estimate))
            yield doubt_boxes(estimate)

    def _convergence(self, estimate: SceneEstimate) -> Iterator[Drawing]:
        """The filter of the winning hypothesis at work."""
        yield from (Clear(path) for path in ("world/camera/particles", "cost"))
        winner = next((item for item in self._posteriors if _same_objects(item, estimate)), None)
        if winner is not None:
            yield from particle_frames(winner, self._colors)

    def _overlay(self, frame: Frame, estimate: SceneEstimate) -> np.ndarray[Any, np.dtype[np.uint8]]:
        """The observation in grey with the estimated objects, rendered, laid over it."""
        height, width = frame.depth.shape
        if (width, height) not in self._renderers:
            self._renderers[width, height] = Renderer(width, height)
        items = [Item(self._catalogue[item.label].mesh, item.T_camera_object) for item in estimate.objects]
        camera = Camera(K=frame.K, T_world_camera=np.eye(4))
        rendered = self._renderers[width, height].color(items, camera)
        grey = np.repeat(frame.rgb.mean(axis=2, keepdims=True), 3, axis=2)
        covered = rendered.any(axis=2, keepdims=True)
        return np.where(covered, 0.2 * grey + 0.8 * rendered, grey).astype(np.uint8)

    def _scene(self, scene: SceneGraph) -> Iterator[Drawing]:
        labels = {item.name: item.label for item in scene.objects}
        yield from (Clear(f"world/objects/{name}") for name in sorted(set(self._shown) - set(labels)))
        yield table_plane(scene)
        for item in scene.objects:
            path = f"world/objects/{item.name}"
            yield Transform(path, item.T_base_object)
            if self._shown.get(item.name) != item.label:
                yield _mesh(f"{path}/mesh", self._catalogue[item.label].mesh)
        self._shown = labels
        yield scene_nodes("graph/scene", scene, self._catalogue)

    @cached_property
    def _body(self) -> Body:
        return read_robot(self._robot_file).body

    def _robot(self, names: Sequence[str], positions: Floats) -> Iterator[Drawing]:
        if not self._joints:
            yield from robot_shapes(self._body)
        self._joints.update(zip(names, positions.tolist(), strict=True))
        yield from robot_posture(self._body, self._joints)

    def _motion(self, command: RobotCommand) -> Iterator[Drawing]:
        """The commanded motion, thinned; the robot must have been drawn before."""
        if not self._joints or not len(command.times):
            return
        for row in np.unique(np.linspace(0, len(command.times) - 1, MOTION_FRAMES).round().astype(int)):
            yield NextStep()
            self._joints.update(zip(command.joint_names, command.positions[row].tolist(), strict=True))
            yield from robot_posture(self._body, self._joints)


def palette(labels: Sequence[str]) -> dict[str, Color]:
    """A colour per label, spread around the colour circle; the same labels always get the same ones."""
    golden = 0.618034
    shades = [hsv_to_rgb(k * golden % 1, 0.65, 0.95) for k in range(len(labels))]
    return {
        label: (round(255 * r), round(255 * g), round(255 * b)) for label, (r, g, b) in zip(labels, shades, strict=True)
    }


def candidate_boxes(message: Candidates, colors: Mapping[str, Color]) -> Boxes2D:
    """The candidates over the camera image, with label and confidence."""
    found = message.candidates
    return Boxes2D(
        "camera/candidates",
        np.array([item.box for item in found]).reshape(-1, 4),
        labels=tuple(f"{item.label} {item.confidence:.2f}" for item in found),
        colors=tuple(colors.get(item.label, _GREY) for item in found),
    )


def observation_points(message: Observation) -> Iterator[Drawing]:
    """What stands above the support plane, as coloured points in the camera's frame."""
    rows, columns = np.nonzero(message.foreground & (message.depth > 0))
    yield Transform("world/camera", base_from_camera(message))
    points = back_project(message.depth, message.K)[rows, columns]
    yield Points3D("world/camera/observation", points, message.rgb[rows, columns], radius=0.001)


def base_from_camera(message: Observation | SceneEstimate) -> Floats:
    """T_base_camera, 4 x 4; without a robot the support plane is the base."""
    if message.T_base_camera is not None:
        return message.T_base_camera
    return np.linalg.inv(message.T_camera_table).astype(np.float64)


def particle_frames(posterior: Posterior, colors: Mapping[str, Color]) -> Iterator[Drawing]:
    """The particles of each object over the kept iterations, one step each, and the best cost."""
    for item, trace in zip(posterior.objects, posterior.traces, strict=False):
        for iteration, cost in zip(trace.iterations, trace.costs.tolist(), strict=True):
            yield NextStep()
            positions = _particles(trace, iteration)
            yield Points3D(f"world/camera/particles/{item.name}", positions, colors.get(item.label, _GREY))
            yield Scalar(f"cost/{item.name}", cost, item.name)


def _particles(trace: ParticleTrace, iteration: int) -> Floats:
    return trace.positions[trace.positions[:, 0] == iteration, 1:]


def look_text(estimate: SceneEstimate) -> str:
    """The winning hypothesis in words, and how sure it is."""
    sure = "" if estimate.probabilities is None else f", probability {estimate.probabilities[estimate.winner]:.2f}"
    title = f"**Hypothesis {estimate.winner + 1} of {len(estimate.log_weights)} wins{sure}**"
    notes = [f"{estimate.left_out} combinations were left out by the cap."] if estimate.left_out else []
    notes += [f"Nothing is known: {estimate.unusable}."] if estimate.unusable else []
    notes += [f"Something unknown: {_size(item)}, {item.points} readings." for item in estimate.unknown]
    header = ["| object | sure | spread | fit | seen | |", "|---|---|---|---|---|---|"]
    return "\n".join([title, *(f"\n{note}" for note in notes), "", *header, *map(_look_row, estimate.objects)])


def _look_row(item: ObjectPose) -> str:
    sure = "" if item.probability is None else f"{item.probability:.2f}"
    notes = ["**contradicted**"] if item.contradicted else []
    notes += [f"or another pose ({other.probability:.2f})" for other in item.alternatives[:1]]
    notes += ["no telling which side it shows"] if item.facing is not None and item.facing < UNSURE else []
    cells = (item.name, sure, _spread(item), f"{1e3 * item.cost:.1f} mm", f"{item.visible:.0%}", ", ".join(notes))
    return f"| {' | '.join(cells)} |"


def _spread(item: ObjectPose) -> str:
    return (
        "" if item.probability is None else f"{1e3 * item.spread_metres:.0f} mm {np.rad2deg(item.spread_radians):.0f}°"
    )


def _size(region: UnknownRegion) -> str:
    return " x ".join(f"{100 * edge:.0f}" for edge in region.extent_table) + " cm"


def doubt_boxes(estimate: SceneEstimate) -> Boxes2D:
    """Every object over the estimate with its probability and spread, and what no object explains."""
    judged = [item for item in estimate.objects if item.probability is not None]
    labels = ["contradicted" if item.contradicted else _doubt_label(item) for item in judged]
    return Boxes2D(
        "estimate/objects",
        np.array([item.box for item in (*judged, *estimate.unknown)]).reshape(-1, 4),
        labels=(*labels, *("unknown" for _ in estimate.unknown)),
        colors=(*map(_certainty, judged), *(_MAGENTA for _ in estimate.unknown)),
    )


def _doubt_label(item: ObjectPose) -> str:
    """The probability; where that is not sure, the spread too."""
    probability = item.probability or 0.0
    return f"{probability:.2f}" + ("" if probability >= SURE else f" ± {_spread(item)}")


def _certainty(item: ObjectPose) -> Color:
    """Green where the pose can be relied on, red where it cannot."""
    probability = item.probability or 0.0
    if item.contradicted or probability < UNSURE:
        return _RED
    return _GREEN if probability >= SURE else _ORANGE


def doubt_drawings(estimate: SceneEstimate, catalogue: Catalogue) -> Iterator[Drawing]:
    """In space: other poses an object may have, as ghosts of its edges; what is contradicted or unknown, boxed."""
    for item in estimate.objects:
        mesh = _swollen(catalogue[item.label].simplified(GHOST_TRIANGLES))
        for number, other in enumerate(item.alternatives):
            strips = _edges(mesh, other.T_camera_object)
            yield Lines3D(f"world/camera/doubt/{item.name}_{number}", strips, _GHOST, radius=0.0006)
        if item.contradicted:
            low, high = catalogue[item.label].bounds
            box = _box_edges(low, high, item.T_camera_object)
            yield Lines3D(f"world/camera/doubt/{item.name}_contradicted", box, _RED)
    for number, region in enumerate(estimate.unknown):
        low, high = (region.centre_table + sign * region.extent_table / 2 for sign in (-1, 1))
        yield Lines3D(
            f"world/camera/doubt/{region_name(number)}", _box_edges(low, high, estimate.T_camera_table), _MAGENTA
        )


def _swollen(mesh: Mesh) -> Mesh:
    """A little larger, so that an object turned round shows outside itself."""
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    return replace(mesh, vertices=middle + 1.03 * (mesh.vertices - middle))


def _edges(mesh: Mesh, T: Floats) -> tuple[Floats, ...]:
    """The outline of every triangle, moved."""
    vertices = mesh.vertices @ T[:3, :3].T + T[:3, 3]
    return tuple(vertices[[a, b, c, a]] for a, b, c in mesh.faces.tolist())


def _box_edges(low: Floats, high: Floats, T: Floats) -> tuple[Floats, ...]:
    """The twelve edges of a box as four open strips, moved by ``T``."""
    (x0, y0, z0), (x1, y1, z1) = low.tolist(), high.tolist()
    ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    strips = [[(*ring[k], z1), (*ring[k], z0), (*ring[(k + 1) % 4], z0)] for k in range(4)]
    strips.append([(*corner, z1) for corner in (*ring, ring[0])])
    return tuple(np.array(strip) @ T[:3, :3].T + T[:3, 3] for strip in strips)


def table_plane(scene: SceneGraph) -> Mesh3D:
    """The support plane, centred below the objects."""
    origin, normal = scene.T_base_table[:3, 3], scene.T_base_table[:3, 2]
    center = np.mean([item.T_base_object[:2, 3] for item in scene.objects] or [origin[:2]], axis=0)
    corners = center + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(TABLE_SIZE) / 2
    # A millimetre low, so that the bottoms of objects show.
    heights = origin[2] - (corners - origin[:2]) @ normal[:2] / normal[2] - 0.001
    return Mesh3D("world/table", np.column_stack([corners, heights]), np.array([[0, 1, 2], [0, 2, 3]]), (170, 150, 125))


def scene_nodes(path: str, scene: SceneGraph, catalogue: Catalogue) -> Graph:
    """Objects hang on what carries them; virtual objects link the two that belong beside each other."""
    carried = support(scene)
    nodes = {TABLE: (TABLE, _GREY)}
    edges = [(supporter, name) for name, (supporter, _) in carried.items()]
    for item in scene.objects:
        supporter, how = carried[item.name]
        label = item.name if supporter == TABLE else f"{how}: {item.name}"
        nodes[item.name] = (label, _ORANGE if catalogue[item.label].concave else _BLUE)
    for virtual in scene.virtual_objects:
        nodes[virtual.name] = (f"beside {virtual.parent}", _GREEN)
        edges += [(virtual.parent, virtual.name), (virtual.name, virtual.child)]
    labels, colors = zip(*nodes.values(), strict=True)
    places = node_places(scene)
    positions = np.array([places[name] for name in nodes]) * np.array(NODE_SPACING)
    return Graph(path, tuple(nodes), labels, tuple(edges), colors, positions)


def node_places(scene: SceneGraph) -> dict[str, tuple[float, float]]:
    """(column, row) of every node: a tree with the table on top; a region hangs between its parent and child."""
    carried = support(scene)
    places: dict[str, tuple[float, float]] = {}
    columns = count()

    def place(name: str, row: int) -> float:
        children = [child for child, (supporter, _) in carried.items() if supporter == name]
        inner = [place(child, row + 1) for child in children]
        column = sum(inner) / len(inner) if inner else float(next(columns))
        places[name] = (column, float(row))
        return column

    place(TABLE, 0)
    for virtual in scene.virtual_objects:
        (x0, y0), (x1, y1) = places[virtual.parent], places[virtual.child]
        places[virtual.name] = ((x0 + x1) / 2, (y0 + y1) / 2 + 0.5)
    return places


def plan_text(plan: Plan) -> str:
    """The plan as a numbered list, or why there is none."""
    if plan.status != "solved":
        return f"### {plan.status}\n{plan.reason}"
    steps = [f"{number}. `{item.pick}` `{item.place}`" for number, item in enumerate(plan.transfers, 1)]
    bound = f"every plan needs {plan.at_least} transfers at least; {plan.expanded} states expanded"
    return "\n".join(["### Plan", *steps, "", bound])


def progress_line(message: Message) -> str:
    """A line of the episode's story; empty for messages that do not move it on."""
    line = ""
    match message:
        case Teach(name=name):
            line = f"asked to remember **{name}**"
        case Restore(name=name):
            line = f"asked to restore **{name}**"
        case Arrange(kind=kind):
            line = f"asked for a {kind} scene"
        case Arrangement(kind=kind):
            line = f"the person lays out the **{kind}** scene"
        case LookRequest(purpose=purpose):
            line = f"look: {purpose}"
        case Goal(name=name):
            line = f"goal **{name}** remembered"
        case Plan(status=status, transfers=transfers):
            line = f"plan {status}" + (f", {len(transfers)} transfers" if transfers else "")
        case TransferRequest(number=number, transfer=transfer):
            line = f"transfer {number}: {transfer.object} to {transfer.destination}"
        case Outcome(number=number, success=success, failed_stage=stage, reason=reason):
            line = f"transfer {number} " + ("felt to stand" if success else f"failed at {stage}: {reason}")
        case CameraCalibration(success=success, reason=reason):
            line = f"**{'calibrated' if success else 'not calibrated'}**: {reason}"
        case Verdict(success=success, reason=reason):
            line = f"**{'restored' if success else 'not restored'}**: {reason}"
        case _:
            pass
    return line


def robot_shapes(body: Body) -> Iterator[Drawing]:
    """The meshes of every link, each below its link's path, flat-shaded: corners that share a vertex look dented."""
    for number, (link, mesh) in enumerate(body.meshes):
        corners = mesh.faces.reshape(-1)
        faces = np.arange(len(corners)).reshape(-1, 3)
        yield Mesh3D(f"world/robot/{link}/mesh_{number}", mesh.vertices[corners], faces, mesh.colors[corners])


def robot_posture(body: Body, joints: Mapping[str, float]) -> Iterator[Drawing]:
    """Where the links are for these joint positions."""
    poses = body.link_poses(list(joints), np.array(list(joints.values())))
    for link in sorted({link for link, _ in body.meshes}):
        yield Transform(f"world/robot/{link}", poses[link])


def _mesh(path: str, mesh: Mesh) -> Mesh3D:
    return Mesh3D(path, mesh.vertices, mesh.faces, mesh.colors)


def _same_objects(posterior: Posterior, estimate: SceneEstimate) -> bool:
    pairs = zip(posterior.objects, estimate.objects, strict=False)
    return len(posterior.objects) == len(estimate.objects) and all(
        a.label == b.label and np.array_equal(a.T_camera_object, b.T_camera_object) for a, b in pairs
    )
