"""falconwing sandbox: test the grading sandbox with known escape attempts."""

from dataclasses import asdict, dataclass
from typing import Annotated, Literal

import tyro

from falconwing_kit.tools.cli.show import next_line, print_json, print_table


@dataclass(frozen=True)
class Sandbox:
    """Test the grading sandbox: run known escape attempts and report any that succeed.

    Exit code 0 if all are blocked, 1 if one succeeds; `grade` then refuses to run.
    """

    action: Annotated[Literal["probe"], tyro.conf.Positional]
    """probe: run the attempts"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Run the attempts.

        Returns:
            0 if all are blocked, else 1.

        Raises:
            InputError: bubblewrap is missing.
        """
        from falconwing_kit.tools.grading.sandbox.probe import probe_sandbox

        results = probe_sandbox()
        closed = all(result.closed for result in results)
        if self.json:
            print_json({"closed": closed, "tried": [asdict(result) for result in results]})
        else:
            rows = [(r.name, "closed" if r.closed else "OPEN", r.said) for r in results]
            print_table(("attempt", "sandbox", "result"), rows)
            next_line(
                "falconwing grade lab01 SUBMISSIONS --out grades" if closed else "falconwing doctor"
            )
        return int(not closed)
