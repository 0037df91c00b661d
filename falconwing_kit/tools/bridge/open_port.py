"""A port's name -> the trainer port: hardware on USB, the firmware in a simulated chip, or a board
in plain Python.
"""

from falconwing_kit.tools.bridge.simulated_link import SteppedBoard, open_simulation
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.trainer_port.ppm import Calibration
from falconwing_kit.trainer_port.usb import SerialLink


def open_port(name: str, calibration: Calibration | None = None) -> TrainerPort:
    """The port of a name, in real time.

    Args:
        name: a serial port ("/dev/ttyACM0", "COM3"); "sim": the real firmware in a simulated
            ATmega2560, reached through a pseudo-terminal, or the plain Python board where the tools
            for it are missing; "sim-python": that one.
        calibration: sticks to microseconds; None takes the kit's own.

    Returns:
        The port; its `what` says what it is. Where that is SIMULATED, `simulation` has the board.

    Raises:
        InputError: the port cannot be opened; the text says how to mend that.
    """
    if name not in ("sim", "sim-python"):
        return TrainerPort(
            SerialLink(name), calibration, reopen=lambda: SerialLink(name), what=f"board on {name}"
        )
    simulation, path, kind = open_simulation(name)
    what = f"SIMULATED board, {kind}"
    if isinstance(simulation, SteppedBoard):
        port = TrainerPort(simulation, calibration, what=what)
    else:
        port = TrainerPort(
            SerialLink(path), calibration, reopen=lambda: SerialLink(path), what=what
        )
    port.simulation = simulation
    return port
