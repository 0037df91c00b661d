"""falconwing find-port: list the boards on this machine's serial ports."""

from dataclasses import dataclass

from falconwing_kit.tools.cli.show import json_fields, next_line, print_json, print_table


@dataclass(frozen=True)
class FindPort:
    """List boards on USB, mark those that look like the Mega 2560, and print how to get the
    permission to open them.

    Exit code 0 if one may be it, else 1. None is opened, because that could restart a board.
    """

    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """List the boards.

        Returns:
            0 if a board may be the Mega, else 1.
        """
        from falconwing_kit.trainer_port.usb import find_boards

        boards = find_boards()
        likely = [board for board in boards if board.likely]
        if self.json:
            print_json({"boards": [json_fields(board) for board in boards]})
        elif not boards:
            print("no board on a USB serial port found")
            next_line(
                "connect the Mega with a USB data cable; or use a simulated board, --port sim"
            )
        else:
            rows = [
                (board.path, board.what, board.likely, board.may_open, board.advice)
                for board in boards
            ]
            print_table(("port", "what", "may be it", "may be opened", "fix"), rows)
            usable = next((board.path for board in likely if board.may_open), None)
            next_line(
                f"falconwing bridge --port {usable}"
                if usable
                else "apply the fix in the table, then falconwing find-port again"
            )
        return 0 if likely else 1
