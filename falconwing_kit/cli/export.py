"""`falconwing export`: a flight log in, a flight table or a repaired log out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from falconwing_kit.cli.show import next_line, print_json, print_table
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import read_flight_log, recover, to_flight_table
from falconwing_kit.core.flight_table import write_flight_table


@dataclass(frozen=True)
class Export:
    """Turn a flight log into a flight table, or an interrupted log into a whole one."""

    log: Annotated[Path, tyro.conf.Positional]
    """the flight log (MCAP), also one whose writing was cut short"""
    out: Path
    """the file to write, or a folder to write it into"""
    to: Literal["csv", "mcap"] = "csv"
    """csv: one row per image with pose and command; mcap: all that can be read, indexed and compressed"""
    json: bool = False
    """print the result as JSON"""

    def run(self) -> int:
        """Write the file and say what is in it.

        Returns:
            0: the file is written.

        Raises:
            FileNotFoundError: there is no log, or no folder for the file.
            InputError: the log cannot be used, or the file cannot be written or is the log itself.
        """
        target = self.out / f"{self.log.stem}.{self.to}" if self.out.is_dir() else self.out
        if target.resolve() == self.log.resolve():
            raise InputError(f"{target}: want another name than the log's own, so that the log is kept")
        counts, warnings = self._to_table(target) if self.to == "csv" else self._to_log(target)
        if self.json:
            print_json({"file": str(target), **counts, "warnings": list(warnings)})
            return 0
        print_table(["what", "count"], list(counts.items()), title=str(target))
        for sentence in warnings:
            print(f"warning: {sentence}")
        use = f"falconwing identify {target}" if self.to == "csv" else f"falconwing export {target} --to csv"
        next_line(use)
        return 0

    def _to_table(self, target: Path) -> tuple[dict[str, int], tuple[str, ...]]:
        table = to_flight_table(read_flight_log(self.log))
        write_flight_table(target, table)
        return {"rows": len(table.t), "rows with a pose": int(table.has_pose.sum())}, table.warnings

    def _to_log(self, target: Path) -> tuple[dict[str, int], tuple[str, ...]]:
        saved = recover(self.log, target)
        return {topic.strip("/"): count for topic, count in saved.counts.items()}, saved.warnings
