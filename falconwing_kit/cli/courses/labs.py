"""falconwing labs: the labs' sources -> notebooks, what is handed out to students, a test of the labs themselves."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from falconwing_kit.cli.show import next_line, print_json, print_table
from falconwing_kit.core.files import short_name
from falconwing_kit.grading.find import lab_folder, lab_folders, labs_folder


@dataclass(frozen=True)
class Labs:
    """Build the labs' notebooks from their sources.

    Exit code 0 when it was done, or nothing is stale; else 1.
    """

    action: Annotated[Literal["build"], tyro.conf.Positional]
    """build: write each lab's two notebooks from its lab.py"""
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """labs, such as lab03; all if none is named"""
    check: bool = False
    """build: write nothing, say which notebooks are stale"""
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Do it.

        Returns:
            0 where it is done and well, else 1.

        Raises:
            InputError: there is no such lab, or its files cannot be used.
        """
        labs = labs_folder(self.labs)
        folders = [lab_folder(name, labs) for name in self.names] or lab_folders(labs)
        return self._build(folders)

    def _build(self, folders: list[Path]) -> int:
        from falconwing_kit.grading.notebooks import stale_notebooks, write_notebooks

        changed = {folder.name: (stale_notebooks if self.check else write_notebooks)(folder) for folder in folders}
        stale = sum(map(len, changed.values())) if self.check else 0
        if self.json:
            print_json({name: [short_name(path) for path in paths] for name, paths in changed.items()})
            return int(stale > 0)
        word = "stale" if self.check else "written"
        rows = [(name, ", ".join(map(short_name, paths)) or "-") for name, paths in changed.items()]
        print_table(("lab", word), rows, title=f"{len(rows)} labs, {stale} stale notebooks" if self.check else "")
        next_line("falconwing labs build" if stale else "falconwing labs selftest")
        return int(stale > 0)
