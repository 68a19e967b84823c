"""What is not installed, or installed twice, is said in a line."""

import sys
from importlib import metadata

import pytest

from laboratory import refusal
from mjx_revolve.inputs import packages
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.packages import REQUIREMENTS, check_mujoco, check_package


@pytest.mark.parametrize("module", REQUIREMENTS)
def test_a_missing_package_is_named_with_its_remedy(module, monkeypatch):
    check_package("here", "json")
    monkeypatch.setitem(sys.modules, module, None)
    remedy = f"(pip install '{REQUIREMENTS[module]}')"
    expected = f"here: expected the package {module}; found none {remedy}"
    assert refusal(check_package, "here", module) == expected


def of_mujoco(monkeypatch, **found):
    def version(name):
        if name not in found:
            raise metadata.PackageNotFoundError(name)
        return found[name]

    monkeypatch.setattr(packages, "version", version)


def test_mixed_installations_of_mujoco_are_refused_at_start(monkeypatch, capsys):
    of_mujoco(monkeypatch, mujoco="3.17.0")
    check_mujoco()
    of_mujoco(monkeypatch, **{"mujoco": "4.0.0", "mujoco-core": "4.0.0"})
    check_mujoco()
    of_mujoco(monkeypatch, **{"mujoco": "3.17.0", "mujoco-core": "4.0.0"})
    assert run_command(lambda argv: 0, []) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: mujoco: expected one version; found 3.17.0 with a mujoco-core")
    assert error.count("\n") == 1
