import os
import subprocess
import sys

from scenes.gl import INSTALL_EGL, INSTALL_OSMESA, choose_route

WORKS, BROKEN = (lambda: True, "install it"), (lambda: False, "install it")


def test_first_route_that_works_is_taken():
    assert choose_route("", {"egl": WORKS, "osmesa": WORKS}) == ("egl", "")
    assert choose_route("", {"egl": BROKEN, "osmesa": WORKS}) == ("osmesa", "")


def test_wanted_route_is_respected_and_never_replaced_silently():
    assert choose_route("osmesa", {"egl": WORKS, "osmesa": WORKS}) == ("osmesa", "")
    route, problem = choose_route("osmesa", {"egl": WORKS, "osmesa": BROKEN})
    assert route == "disable"
    assert "MUJOCO_GL=osmesa" in problem


def test_routes_only_mujoco_knows_are_left_to_it():
    assert choose_route("glfw", {"egl": BROKEN}) == ("glfw", "")


def test_without_any_route_the_problem_names_the_command():
    route, problem = choose_route("", {"egl": BROKEN, "osmesa": BROKEN})
    assert route == "disable"
    assert INSTALL_OSMESA in problem
    assert "apt-get install" in INSTALL_EGL


def test_physics_runs_and_rendering_explains_itself_without_opengl():
    """In a fresh interpreter in which every probe fails, scenes imports and only rendering raises SceneError."""
    code = (
        "import ctypes, ctypes.util\n"
        "def missing(*_): raise OSError('missing')\n"
        "load, ctypes.CDLL = ctypes.CDLL, missing\n"
        "ctypes.util.find_library = lambda name: None\n"
        "import os; os.environ.pop('MUJOCO_GL', None)\n"
        "from scenes.gl import choose_route, ROUTES\n"
    )
    check = (
        "ctypes.CDLL = load\n"
        "from scenes.errors import SceneError\n"
        "from scenes.gl import make_context, mujoco\n"
        "mujoco.MjSpec().compile()\n"
        "try: make_context(8, 8)\n"
        "except SceneError as error: assert 'apt-get install' in str(error), error\n"
        "else: raise AssertionError('a context without OpenGL')\n"
    )
    # MuJoCo loads its own library with ctypes on some systems, so it is imported before ctypes is broken.
    first = "import os; os.environ['MUJOCO_GL'] = 'disable'; import mujoco\n"
    environment = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    done = subprocess.run([sys.executable, "-c", first + code + check], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
