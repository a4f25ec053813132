"""Views of meshes: how many, how large, and that their file gives them back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from runner.contract import Refused
from stages.perception.detection import learn
from stages.perception.detection.views import Views
from stages.scene.catalogue import Catalogue
from stages.scene.catalogue.mesh_shape import resting_rotations
from tests.stages.perception.detection.scenes import NAMES, OBJECTS, views


def test_every_object_is_seen_in_every_way_it_rests_from_all_sides() -> None:
    learned = views()
    assert learned.labels == NAMES
    for index, item in enumerate(OBJECTS.objects.values()):
        assert (learned.label == index).sum() == 4 * 3 * len(resting_rotations(item.mesh))
    assert sorted(set(learned.elevation)) == [10, 30, 50, 70]


def test_sizes_are_metres() -> None:
    learned = views()
    of_bowl = learned.label == NAMES.index("bowl")
    width, _, height = OBJECTS["bowl"].dimensions
    np.testing.assert_allclose(learned.top[of_bowl], height, atol=0.002)
    np.testing.assert_allclose(learned.extent[of_bowl, 0], width, rtol=0.15)


def test_the_file_is_small_and_gives_back_what_was_learned(tmp_path: Path) -> None:
    learned = views()
    path = tmp_path / "new" / "views.safetensors"
    learned.save(path)
    assert path.stat().st_size < 4000 * len(learned.label)
    again = Views.load(path)
    assert again.labels == learned.labels
    np.testing.assert_array_equal(again.label, learned.label)
    np.testing.assert_array_equal(again.outline, learned.outline)
    np.testing.assert_allclose(again.middle, learned.middle, rtol=0.002, atol=0.002)
    alike = (again.grid * learned.grid).sum(-1)[learned.covered]
    assert alike.min() > 0.99
    assert list(path.parent.iterdir()) == [path]


def test_something_else_is_refused_with_the_command_that_makes_views(tmp_path: Path) -> None:
    (tmp_path / "some.safetensors").write_bytes(b"nothing of that kind")
    for name in ("some.safetensors", "absent.safetensors"):
        with pytest.raises(Refused, match=rf"{name}: not the views of a catalogue .*detection\.learn CATALOGUE OUT"):
            Views.load(tmp_path / name)


def test_a_catalogue_is_learned_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = views()
    learned: list[Catalogue] = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(Views, "learn", lambda catalogue: learned.append(catalogue) or made)
    assert Views.cached(OBJECTS).labels == Views.cached(OBJECTS).labels == NAMES
    bowl = OBJECTS["bowl"]
    other = replace(bowl, mesh=replace(bowl.mesh, colors=255 - bowl.mesh.colors))
    Views.cached(Catalogue({"bowl": other}))
    assert len(learned) == 2


def test_the_command_writes_the_file_and_refuses_what_is_no_catalogue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = views()
    monkeypatch.setattr(Views, "learn", lambda _: made)
    catalogue = Path(__file__).parents[4] / "stages/scene/catalogue.yaml"
    monkeypatch.setattr("sys.argv", ["learn", str(catalogue), str(tmp_path / "out.safetensors")])
    assert learn.main() == 0
    assert capsys.readouterr().out.startswith(f"3 objects, {len(made.label)} views, ")
    monkeypatch.setattr("sys.argv", ["learn", str(tmp_path / "absent"), str(tmp_path / "out")])
    assert learn.main() == 1
    assert "no such catalogue" in capsys.readouterr().err
