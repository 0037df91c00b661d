"""falconwing reproduce: remake what a simulation can of the paper, beside its numbers."""

from dataclasses import asdict, dataclass
from pathlib import Path

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.tools.cli.show import next_line, print_json, print_table


@dataclass(frozen=True)
class Reproduce:
    """Compute the paper's tables and figures: sizing, renderer, pose network, identification,
    Table I, robustness and Table II, each number beside the paper's with interval and verdict.

    What needs a real aircraft, a second hall or pilots that do not ship is a row that says so.
    Flights are simulated; the same command goes on where it was ended. Quick takes up to five
    minutes on two cores, full some hours.
    """

    only: str = ""
    """parts separated by commas: sizing, renderer, pose_network, identification, table_one,
    robustness, table_two; all if not given
    """
    quick: bool = False
    """few trials; the default"""
    full: bool = False
    """as many trials as the paper or more"""
    workers: int = 2
    """processes that share trials and images"""
    out: Path = Path("reproduction")
    """folder for page, rows, figures and records"""
    json: bool = False
    """print JSON instead of tables"""

    def run(self) -> int:
        """Compute and write.

        Returns:
            0: the page is written.

        Raises:
            InputError: an option is wrong, or the folder holds trials of another version.
        """
        from falconwing_kit.tools.cli.progress import StageProgress
        from falconwing_kit.tools.trials.reproduction import (
            FULL,
            PARTS,
            QUICK,
            SHARES,
            Job,
            reproduce,
        )
        from falconwing_kit.tools.trials.reproduction_page import (
            count_verdicts,
            write_reproduction,
        )

        if self.quick and self.full:
            raise InputError("--quick, --full: expected one of them, got both; take one")
        require_range("--workers", self.workers, low=1, high=256)
        if self.out.exists() and not self.out.is_dir():
            raise InputError(
                f"--out {self.out}: expected a folder, got a file; choose another name"
            )
        names = [name.strip() for name in self.only.split(",") if name.strip()] or list(PARTS)
        amount = FULL if self.full else QUICK
        total, done = sum(SHARES.get(name, 0.0) for name in names), 0.0
        stages = []
        for name in PARTS:
            if name in names:
                stages.append((f"{name}:", done / total))
                done += SHARES[name]
        with StageProgress("reproduce", stages) as progress:
            parts = reproduce(names, Job(amount, self.out, self.workers, progress))
        files = write_reproduction(parts, amount, self.out)
        if self.json:
            print_json({
                "amount": amount.name, "counts": count_verdicts(parts),
                "rows": [
                    {"part": name} | asdict(row)
                    for name, part in parts.items() for row in part.rows
                ],
            })  # fmt: skip
            return 0
        for name, part in parts.items():
            print_table(
                ("quantity", "paper", "kit", "95 %", "n", "result", "made by"),
                [
                    (r.quantity, r.paper, r.kit or "-", r.interval or "-", r.n or "-", r.verdict,
                     r.mark)
                    for r in part.rows
                ],
                title=PARTS[name][0],
            )  # fmt: skip
            print()
        next_line(f"open {files['page']}")
        return 0
