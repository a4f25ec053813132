import ctypes

import pytest

from runner.contract import Refused
from stages.devices.egl import examine_egl


def test_names_what_renders_here(monkeypatch: pytest.MonkeyPatch):
    assert examine_egl().endswith("with OpenGL and without a display")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "osmesa")
    assert examine_egl().endswith("PYOPENGL_PLATFORM=osmesa keeps PyOpenGL from it: unset it")


def test_says_what_to_type_where_the_library_is_missing(monkeypatch: pytest.MonkeyPatch):
    library = ctypes.CDLL
    monkeypatch.setattr(ctypes, "CDLL", lambda name: library(f"absent-{name}"))
    with pytest.raises(Refused, match=r"absent-libEGL.so.1: .*; type: apt-get install libegl1"):
        examine_egl()
