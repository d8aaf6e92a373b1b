"""Filament where a driver is missing: the command that mends it is told, and the process lives on."""

import os
import subprocess
import sys

from scenes.vulkan import INSTALL_VULKAN, vulkan_problem

REFUSED = """
import sys
{before}
from scenes.domains import domain_problem, make_renderer
from scenes.errors import SceneError
from scenes.gl import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
try:
    make_renderer("filament", model, max_width=8, max_height=8)
except SceneError as error:
    assert str(error) == domain_problem("filament")
    print(error)
"""


WITHOUT_LOADER = """
import ctypes
load = ctypes.CDLL
def without_vulkan(name, *rest, **more):
    if "vulkan" in str(name):
        raise OSError(name)
    return load(name, *rest, **more)
ctypes.CDLL = without_vulkan
"""


def refusal(before="", **environment):
    """What a process of its own prints when it asks for Filament."""
    done = subprocess.run(
        [sys.executable, "-c", REFUSED.format(before=before)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_without_a_driver_the_command_that_mends_it_is_told():
    message = refusal(VK_ICD_FILENAMES="/nonexistent", VK_DRIVER_FILES="/nonexistent")
    assert message.startswith("cannot render the filament domain: no Vulkan")
    assert message.endswith(f"run\n  {INSTALL_VULKAN}\n")


def test_without_the_vulkan_loader_the_command_that_mends_it_is_told():
    assert vulkan_problem("libvulkan-of-nowhere.so") == "the Vulkan loader libvulkan-of-nowhere.so is missing"
    message = refusal(WITHOUT_LOADER)
    assert "the Vulkan loader libvulkan.so.1 is missing" in message and INSTALL_VULKAN in message


def test_a_mujoco_without_filament_is_told():
    message = refusal("import scenes.gl\nsys.modules['mujoco.mjrf'] = None")
    assert message.startswith("cannot render the filament domain: MuJoCo's Filament does not load")
    assert "pip install" in message


def test_nothing_is_written_to_standard_output():
    before = "sys.argv = ['']"
    assert refusal(before) == ""
