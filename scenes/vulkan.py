"""Whether this machine can draw with Vulkan, found out without starting a renderer.

A renderer that finds no Vulkan device ends the whole process, so it must not be tried.
"""

from __future__ import annotations

import ctypes

VULKAN_PACKAGES = ("libvulkan1", "mesa-vulkan-drivers")
"""Debian packages of the loader and of a driver that needs no GPU."""
INSTALL_VULKAN = f"apt-get install -y {' '.join(VULKAN_PACKAGES)}"
_STRUCTURE_TYPE_INSTANCE_CREATE_INFO = 1
_SUCCESS = 0


class _InstanceCreateInfo(ctypes.Structure):
    """``VkInstanceCreateInfo`` of the Vulkan specification; all that is not set means "none"."""

    _fields_ = [
        ("sType", ctypes.c_int),
        ("pNext", ctypes.c_void_p),
        ("flags", ctypes.c_uint32),
        ("pApplicationInfo", ctypes.c_void_p),
        ("enabledLayerCount", ctypes.c_uint32),
        ("ppEnabledLayerNames", ctypes.c_void_p),
        ("enabledExtensionCount", ctypes.c_uint32),
        ("ppEnabledExtensionNames", ctypes.c_void_p),
    ]


def vulkan_problem(library: str = "libvulkan.so.1") -> str:
    """What keeps Vulkan from working, e.g. "no Vulkan device was found"; empty when there is a device."""
    try:
        vulkan = ctypes.CDLL(library)
    except OSError:
        return f"the Vulkan loader {library} is missing"
    instance, count = ctypes.c_void_p(), ctypes.c_uint32()
    info = _InstanceCreateInfo(sType=_STRUCTURE_TYPE_INSTANCE_CREATE_INFO)
    if vulkan.vkCreateInstance(ctypes.byref(info), None, ctypes.byref(instance)) != _SUCCESS:
        return "no Vulkan driver was found"
    enumerated = vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    vulkan.vkDestroyInstance(instance, None)
    return "" if enumerated == _SUCCESS and count.value else "no Vulkan device was found"
