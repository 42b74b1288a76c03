"""Copies the examples into the wheel; everything else is declared in pyproject.toml.

The repository has one copy of the examples, the folder `examples/`. In the wheel they are `pathreplay/examples/`, from
which `pathreplay examples` writes them out. Results that examples have written are left out.
"""

from __future__ import annotations

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SOURCES = (".exr", ".md", ".py", ".sh", ".toml", ".xml")


class BuildWithExamples(build_py):
    """Build the package, and copy the sources of the examples unless the installation is editable."""

    def examples(self) -> dict[str, str]:
        """Return the path of each source of an example in the wheel, and in the repository."""
        if self.editable_mode:
            return {}
        files = sorted(path for path in Path("examples").glob("*/*") if path.suffix in SOURCES)
        return {str(Path(self.build_lib, "pathreplay", path)): str(path) for path in files}

    def run(self) -> None:
        super().run()
        for target, source in self.examples().items():
            self.mkpath(str(Path(target).parent))
            self.copy_file(source, target)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        return [*super().get_outputs(include_bytecode), *self.examples()]

    def get_output_mapping(self) -> dict[str, str]:
        return {**super().get_output_mapping(), **self.examples()}

    def get_source_files(self) -> list[str]:
        return [*super().get_source_files(), *self.examples().values()]


setup(cmdclass={"build_py": BuildWithExamples})
