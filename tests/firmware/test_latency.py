"""How long a command takes from its first byte to the first edge of the frame that carries it, in
virtual time.
"""

import numpy as np

from tests.firmware.chip import BYTE, COMMAND_BYTES, slots

FRAME = 0.022  # s


def test_a_command_is_on_the_pin_within_30_ms_and_mostly_24(bench):
    """The law: 16 bytes at 115200 baud, then a wait for the next frame that is uniform over 22 ms.

    So between 1.4 and 23.4 ms, 12.4 on average, 22.3 at 95 %; the program may add a millisecond.
    The bounds are the issue's. 400 commands at random phases; the wait's mean is known to 22 /
    sqrt(12 * 400) = 0.3 ms.
    """
    rng = np.random.default_rng(5)
    bench.engage()
    board, sent, values = bench.board, [], []
    board.ppm_frames()
    for k in range(400):
        values.append(1500 + k % 2 * 200)  # so that one frame shows which command it carries
        sent.append(board.t)
        bench.send((1250, values[-1], 1500, 1500))
        bench.wait(rng.uniform(0.04, 0.06))
    bench.wait(FRAME)
    frames = board.ppm_frames()
    starts, second = np.array([frame.t_start for frame in frames]), slots(frames)[:, 1]
    waits = []
    for t, value in zip(sent, values, strict=True):
        waits.append(starts[(starts > t) & (np.abs(second - value) <= 1.0)][0] - t)
    waits = np.array(waits)
    transfer = COMMAND_BYTES * BYTE
    assert waits.min() > transfer
    assert abs(waits.mean() - (transfer + FRAME / 2)) < 0.001 + 3 * 0.0003
    assert np.quantile(waits, 0.95) <= 0.024
    assert waits.max() <= 0.030
