"""Puts the configurations and robots at the repository's top inside the wheel."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithData(build_py):
    """Builds the package, and copies what `mjx_revolve.inputs.shipped` looks for into it."""

    def run(self) -> None:
        """A checkout that is installed editable has them where they are."""
        super().run()
        if not self.editable_mode:
            for name in ("configs", "morphologies"):
                place = Path(self.build_lib) / "mjx_revolve" / name
                shutil.copytree(name, place, dirs_exist_ok=True)
                for path in place.glob("*.yaml"):  # schemas are nearer there
                    text = path.read_text("utf-8").replace("=../mjx_revolve/schemas", "=../schemas")
                    path.write_text(text, "utf-8")


setup(cmdclass={"build_py": BuildWithData})
