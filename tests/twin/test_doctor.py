"""The doctor: what a machine lacks is said with the command that mends it."""

import os

import pytest

from twin import doctor as module
from twin.robot import TwinError


def states(monkeypatch, **problems):
    """Pretend that domains have these problems; returns the list of what gets installed."""
    monkeypatch.setattr(module, "domain_state", lambda domain: problems.get(domain, ""))
    installed = []
    monkeypatch.setattr(module, "install", lambda packages, purpose: installed.append(packages))
    return installed


def test_a_working_machine_is_left_alone(monkeypatch):
    installed = states(monkeypatch)
    report = module.doctor(fix=True)
    assert report["classic rendering"] == report["filament rendering"] == report["mitsuba rendering"] == "works"
    assert installed == []


def test_without_any_rendering_the_command_is_named(monkeypatch):
    states(monkeypatch, classic="no EGL")
    with pytest.raises(TwinError, match="apt-get install -y libegl1 libopengl0 libgl1-mesa-dri"):
        module.doctor()


def test_a_missing_optional_domain_is_reported_and_is_no_error(monkeypatch):
    installed = states(monkeypatch, filament="needs Vulkan; run\n  apt-get install -y libvulkan1")
    assert module.doctor()["filament rendering"] == "needs Vulkan; run apt-get install -y libvulkan1"
    assert installed == []
    module.doctor(fix=True)
    assert installed == [module.VULKAN_PACKAGES]


def test_a_probe_that_dies_does_not_take_the_doctor_down(monkeypatch):
    monkeypatch.setitem(module._PROBES, "filament", "import os; os.abort()")
    assert "code -6" in module.domain_state("filament")
    assert module.domain_state("classic") == ""


def test_who_may_not_install_is_told_what_to_run(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(TwinError, match="run: sudo sh -c 'apt-get update && apt-get install -y libvulkan1"):
        module.install(module.VULKAN_PACKAGES, "the filament domain")
