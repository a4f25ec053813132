"""Whether pictures can be rendered here without a display."""

from __future__ import annotations

import ctypes
import os

from runner.contract import Refused

_PLATFORM_SURFACELESS = 0x31DD
_VENDOR, _VERSION = 0x3053, 0x3054
_OPENGL_API = 0x30A2


def examine_egl() -> str:
    """Opens a display without a screen and names it.

    Raises:
        Refused: with what does not work, and what to type.
    """
    try:
        found = _open_display()
    except OSError as error:
        raise Refused(
            f"no picture can be rendered without a display: {error}; type: apt-get install libegl1 libgl1 "
            f"libgl1-mesa-dri (or install the driver of the graphics card)"
        ) from None
    platform = os.environ.get("PYOPENGL_PLATFORM", "egl")
    return found if platform == "egl" else f"{found}, but PYOPENGL_PLATFORM={platform} keeps PyOpenGL from it: unset it"


def _open_display() -> str:
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = egl.eglQueryString.restype = ctypes.c_void_p
    address = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not address:
        raise OSError("libEGL.so.1 knows no platforms (eglGetPlatformDisplayEXT)")
    prototype = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)
    display = ctypes.c_void_p(prototype(address)(_PLATFORM_SURFACELESS, None, None))
    major, minor = ctypes.c_int(), ctypes.c_int()
    if not display or not egl.eglInitialize(display, ctypes.byref(major), ctypes.byref(minor)):
        raise OSError(f"no display could be opened (EGL error {egl.eglGetError():#x})")
    if not egl.eglBindAPI(_OPENGL_API):
        raise OSError("the driver has OpenGL ES only")
    texts = (ctypes.cast(egl.eglQueryString(display, name), ctypes.c_char_p).value for name in (_VERSION, _VENDOR))
    version, vendor = ((text or b"").decode() for text in texts)
    return f"EGL {version} by {vendor}, with OpenGL and without a display"
