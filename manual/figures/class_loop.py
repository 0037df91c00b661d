"""The loop at the top of README: a class flown step by step, its wall in Chromium -> class.webp.

    .venv/bin/python manual/figures/class_loop.py

Everything shown is the kit's own, simulated: `falconwing class` with its server, session and wall.
Only its clock waits for each picture, because a browser without a graphics card draws one or two a
second; and the student is a script, which steers down the centre line with the beginner's assist.
It takes three minutes and needs Chromium and playwright (extra dev).
"""

import io
import math
import shutil
import tempfile
import threading
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.messages import State
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.scene import load_scene
from falconwing_kit.tools.classroom.channel import SticksMessage
from falconwing_kit.tools.classroom.hands import Hands
from falconwing_kit.tools.classroom.pack_scene import pack_scene
from falconwing_kit.tools.classroom.room import Room
from falconwing_kit.tools.classroom.server import LOCAL, Server
from falconwing_kit.tools.classroom.session import Session, SessionSettings

OUT = Path(__file__).with_name("class.webp")
SIZE, SHOWN = (1600, 900), (800, 450)  # of the page and of the film [px]
STEPS, FRAME_MS = 2, 100  # steps of 50 ms between two frames
BEGIN_S = 10.0  # of the flight: nothing is filmed before
STUDENT_X = -15.5  # where the student is given the sticks, before the marker [m]
AIM_X, GLIDE = -5.0, 0.13  # where the student aims, and the slope of the way down
DRAWN_S = 1.6  # a browser's time to draw a frame by software


class StepClock:
    """A clock that goes on when it is told to."""

    speed, paused = 1.0, False

    def __init__(self) -> None:
        self.t, self.allowed, self.ended = 0.0, 0.0, threading.Event()
        self._news = threading.Condition()

    def start(self) -> None:
        """A new flight begins."""
        self.t = 0.0

    def now(self) -> float:
        """Time of the flight [s]."""
        return self.t

    def wait_until(self, t: float) -> None:
        """Wait until `allow` was called for this time."""
        with self._news:
            self._news.wait_for(lambda: t <= self.allowed + 1e-9 or self.ended.is_set())
        self.t = t

    def allow(self, t: float) -> None:
        """Let the flight go on to a time [s]."""
        with self._news:
            self.allowed = t
            self._news.notify_all()

    def stretch(self) -> float:
        """None: the film is played in real time."""
        return 1.0


class Student:
    """A script at the sticks, from STUDENT_X on."""

    def __init__(self, hands: Hands) -> None:
        self.hands, self.sequence, self.is_given = hands, 0, False

    def fly(self, mode: str, state: State) -> None:
        """Sticks for this moment: bank towards the centre line, climb towards the glide."""
        x, y, z = state.p_world
        if not self.is_given and mode == "approach" and x > STUDENT_X:
            self.hands.give(1, "Mia")
            self.hands.sticks(1, SticksMessage(False, True, 1, 0, 0.0, 0.0, 0.0, 0.0))
            self.sequence, self.is_given = 1, True
        if not self.is_given:
            return
        course = math.atan2(-state.v_world[1], state.v_world[0])  # positive to the right
        wanted = float(np.clip(0.12 * y, -0.5, 0.5))
        aileron = float(np.clip(1.2 * (wanted - course), -0.7, 0.7))
        height = 0.30 + GLIDE * max(AIM_X - x, 0.0)
        elevator = float(np.clip(2.0 * (height - z) - 0.9, -1.0, 1.0))
        throttle = 0.45 if z > 0.45 else 0.0
        for _ in range(6):  # the first five engage
            self.sequence += 1
            message = SticksMessage(True, True, self.sequence, 0, throttle, aileron, elevator, 0.0)
            self.hands.sticks(1, message)


class Stage(Room):
    """A room that also shows each step to the student."""

    student: Student

    def step(self, session: Session, step: LoopStep, truth: State) -> None:
        """A step of the flight."""
        super().step(session, step, truth)
        self.student.fly(step.mode, truth)


def main() -> None:
    """Fly, film, and write the film."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pack_scene("arena", folder / "scene.gz")
        packed, scene = (folder / "scene.gz").read_bytes(), load_scene("arena")
        clock = StepClock()
        hands = Hands(True, clock=lambda: clock.t)
        room = Stage(hands, lambda: scene, "arena", lambda: packed, folder)
        room.student = Student(hands)
        hands.set_assist(True)
        room.server = server = Server(room, host=LOCAL, port=0)
        server.start()
        session = Session(
            SessionSettings(folder, laps=1, pause_s=6.0), room, hands, clock=lambda session: clock
        )
        room.session = session
        thread = threading.Thread(target=session.run, args=(1,), daemon=True)
        thread.start()
        frames = film(server.url("/wall"), clock, thread)
        session.request("end")
        server.close()
        room.close()
    with atomic_write(OUT) as file:
        frames[0].save(
            file, "WEBP", save_all=True, append_images=frames[1:], loop=0, quality=60, method=6,
            duration=[FRAME_MS] * (len(frames) - 1) + [1500],
        )  # fmt: skip
    print(f"{OUT.name}: {len(frames)} frames, {OUT.stat().st_size / 1e6:.1f} MB")


def film(url: str, clock: StepClock, flight: threading.Thread) -> list[Image.Image]:
    """Pictures of the wall, one for every STEPS steps, until a second after the verdict."""
    frames: list[Image.Image] = []
    flags = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium") or shutil.which("chromium-browser"), args=flags
        )
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.goto(url)
        page.wait_for_timeout(15_000)  # for the hall
        clock.allow(BEGIN_S)
        page.wait_for_timeout(5_000)
        after = 0
        while after < 12 and len(frames) < 400:
            clock.allow(clock.allowed + STEPS * 0.05)
            page.wait_for_timeout(1000.0 * DRAWN_S)
            picture = page.screenshot(type="jpeg", quality=92)
            frames.append(Image.open(io.BytesIO(picture)).convert("RGB").resize(SHOWN))
            ended = page.is_visible("#verdict") or not flight.is_alive()
            after += ended
        browser.close()
    return frames


if __name__ == "__main__":
    main()
