"""The contact sheet shows every object, and its command refuses what is no catalogue."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import stages.scene
from stages.perception.rendering.contact_sheet import COLUMNS, TILE, looking_at, main

BUILT_IN = Path(stages.scene.__file__).parent / "catalogue.yaml"


def test_every_tile_shows_an_object(tmp_path: Path) -> None:
    assert main([str(BUILT_IN), str(tmp_path / "sheet.png")]) == 0
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))
    assert sheet.shape == (3 * TILE[1], COLUMNS * TILE[0], 3)
    tiles = sheet.reshape(3, TILE[1], COLUMNS, TILE[0], 3).swapaxes(1, 2)
    painted = (tiles[:, :, : TILE[1] - 40] != sheet[0, 0]).any(-1).mean((2, 3))
    assert (painted > 0.08).all()


def test_missing_catalogue_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "none.yaml"), "x.png"]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert main([]) == 2


def test_camera_looks_at_its_target_upright() -> None:
    T = looking_at(np.array([1.0, 2.0, 3.0]), np.zeros(3))
    np.testing.assert_allclose(np.linalg.inv(T) @ [0, 0, 0, 1], [0, 0, np.sqrt(14), 1], atol=1e-12)
    assert T[2, 1] < 0
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
