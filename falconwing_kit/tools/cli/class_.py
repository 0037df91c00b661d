"""falconwing class: fly without end on a page for a whole class; students take the sticks."""

import socket
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.flight.tasks import TRIAL_SEEDS
from falconwing_kit.tools.cli.fly import MANOEUVRE_HELP, TASK_HELP, TaskName
from falconwing_kit.tools.cli.show import next_line

PILOTS_OF_A_CLASS = ("expert", "expert_pid", "pose", "manual")


@dataclass(frozen=True)
class Class:
    """Fly without end, SIMULATED, on a page in the browser until Ctrl-C.

    An autopilot laps the hall, lands and begins again. A student who is given the sticks flies as
    long as the hold button is pressed; the teacher's page has the last word.
    """

    task: Annotated[TaskName, tyro.conf.arg(help=TASK_HELP)] = "landing"
    manoeuvre: Annotated[str, tyro.conf.arg(help=MANOEUVRE_HELP)] = ""
    scene: str = "arena"
    """the hall: arena, hall, or a scene file in the kit's world frame"""
    pilot: Annotated[
        str,
        tyro.conf.arg(
            metavar="{" + ",".join(PILOTS_OF_A_CLASS) + "}",
            help="who flies while no student does; manual: no one, the motor idles",
        ),
    ] = "expert"
    seed: int = 0
    """selects initial states and noise"""
    laps: int = 2
    """of the hall before each landing"""
    lan: bool = False
    """let other machines of this network in, with a token in the address"""
    address: str = ""
    """the address of this machine to bind with --lan; found if not given"""
    web_port: int = 8080
    """TCP port of the page; one of the next ten if it is taken; 0 for any"""
    port: str = ""
    """the trainer port that all commands go through: sim (the firmware in a simulated chip) or
    sim-python (plain Python); none if not given
    """
    real_from_lan: bool = False
    """allow a real board behind --port together with --lan"""
    out: Path | None = None
    """folder for the flight logs; a temporary one, which is removed at the end, if not given"""
    keep: int = 60
    """flight logs that are kept; older ones are removed unless they were recorded"""
    no_browser: bool = False
    """do not open the page on this machine"""
    flights: int = 0
    """end after so many flights; 0 for no end"""

    def run(self) -> int:
        """Serve the page and fly until Ctrl-C.

        Returns:
            0: the class has ended.

        Raises:
            InputError: an option is wrong, or the port cannot be opened.
        """
        self._check()
        from falconwing_kit.tools.classroom.server import LOCAL, Server

        with ExitStack() as stack:
            folder = self._folder(stack)
            room, job = self._room(folder)
            host = self._host() if self.lan else LOCAL
            server = Server(room, host=host, port=self.web_port, lan=self.lan)
            room.server = server
            server.start()
            stack.callback(server.close)
            stack.callback(room.close)
            stack.callback(job.close)
            self._greet(server)
            session = self._session(folder, room, job)
            room.session = session
            with _ctrl_c(lambda: session.request("end")):
                session.run(self.flights or None)
            print(f"{session.flight_number} flights", flush=True)
            next_line(
                f"falconwing replay {folder / 'flight_0001.mcap'}"
                if self.out is not None
                else "falconwing class --out class-logs keeps the logs"
            )
        return 0

    def _check(self) -> None:
        require_range("--seed", self.seed, low=0, high=TRIAL_SEEDS - 1)
        require_range("--laps", self.laps, low=0, high=50)
        require_range("--keep", self.keep, low=1, high=10_000)
        require_range("--flights", self.flights, low=0, high=1_000_000)
        if self.web_port:
            require_range("--web-port", self.web_port, low=1024, high=65000)
        if self.pilot not in PILOTS_OF_A_CLASS:
            names = ", ".join(PILOTS_OF_A_CLASS)
            raise InputError(f"--pilot {self.pilot}: expected one of {names}")
        if self.pilot != "manual":
            from falconwing_kit.flight.pilots import require_pilot

            require_pilot(self.pilot, self.task, "arena" if self.scene == "arena" else "hall")
        if self.port:
            from falconwing_kit.tools.bridge.open_port import PORTS

            if self.port not in PORTS:
                lan = " and never from the network without --real-from-lan" if self.lan else ""
                raise InputError(
                    f"--port {self.port}: this version of the kit flies no real aircraft from the"
                    f" page{lan}; use {' or '.join(PORTS)}"
                )
        if self.out is not None and self.out.exists() and not self.out.is_dir():
            raise InputError(
                f"--out {self.out}: expected a folder, got a file; choose another name"
            )
        from falconwing_kit.tools.classroom.session import make_task
        from falconwing_kit.tools.cli.fly import hall_loader

        make_task(self.task, self.manoeuvre)
        if self.scene != "arena":
            hall_loader(self.scene)

    def _folder(self, stack: ExitStack) -> Path:
        """A new folder for the logs: logs are never overwritten."""
        if self.out is None:
            return Path(
                stack.enter_context(tempfile.TemporaryDirectory(prefix="falconwing_class_"))
            )
        self.out.mkdir(parents=True, exist_ok=True)
        if not any(self.out.glob("flight_*.mcap")):
            return self.out
        number = 2
        while (folder := self.out / f"class_{number}").exists():
            number += 1
        folder.mkdir()
        return folder

    def _host(self) -> str:
        """The one address of this machine that other machines reach."""
        if self.address:
            return self.address
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:  # a datagram socket sends nothing on connect, it only chooses its own address
                probe.connect(("192.0.2.1", 9))
                return str(probe.getsockname()[0])
            except OSError:
                raise InputError(
                    "--lan: expected a network, got none; connect this machine, or give --address"
                ) from None

    def _room(self, folder: Path) -> tuple[Any, Any]:
        from falconwing_kit.tools.classroom.hands import Hands
        from falconwing_kit.tools.classroom.room import Room, SceneJob

        jobs: list[SceneJob] = []
        room = Room(
            Hands(self.pilot != "manual"),
            lambda: jobs[0].scene if jobs else None,
            self.scene,
            lambda: jobs[0].packed if jobs else None,
            folder,
        )
        jobs.append(SceneJob(self.scene, room.preparing))
        return room, jobs[0]

    def _session(self, folder: Path, room: Any, job: Any) -> Any:
        from falconwing_kit.tools.classroom.session import Session, SessionSettings

        settings = SessionSettings(
            folder, self.task, self.manoeuvre, self.scene, self.pilot, self.seed, self.laps,
            self.port, keep=self.keep,
        )  # fmt: skip
        return Session(settings, room, room.hands, scene=lambda: job.scene)

    def _greet(self, server: Any) -> None:
        """Print where the pages are; open the wall on this machine."""
        print("SIMULATION: nothing here flies a real aircraft", flush=True)
        print(f"students: {server.url('/')}")
        print(f"wall:     {server.url('/wall')}")
        print(f"teacher:  {server.url('/desk', key=server.key)}", flush=True)
        if self.lan:
            from falconwing_kit.tools.classroom.qr import qr_blocks

            print(qr_blocks(server.url("/")), flush=True)
        print("Ctrl-C ends the class", flush=True)
        if not self.no_browser:
            url = server.url("/wall")
            threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()


@contextmanager
def _ctrl_c(end: Any) -> Iterator[None]:
    """The first Ctrl-C ends the class after the present step; a second one at once."""
    import signal

    def handle(number: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        print("ending the class", file=sys.stderr, flush=True)
        end()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
