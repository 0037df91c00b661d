"""Frame monitor on ten simulated flights that it was not tuned on: quiet on good video, quick on
bad.
"""

import numpy as np
import pytest

from falconwing_kit.scene.analog import AnalogVideo
from falconwing_kit.vision import FrameMonitor
from tests.vision.flights import PERIOD, TASKS, flown

ONSET = 30  # picture from which something is wrong


def alerts(pictures: list[np.ndarray], rule: str = "motion") -> np.ndarray:
    """(N,) whether there is an alert at each picture."""
    monitor = FrameMonitor(rule)
    return np.array(
        [monitor.update(picture, PERIOD * k).alert for k, picture in enumerate(pictures)]
    )


@pytest.mark.parametrize("number", range(len(TASKS)))
def test_clean_flight_is_no_alert(number):
    """Nothing is wrong with the video; the paper's rule alarms on it, for the aircraft moves."""
    pictures = flown(number)
    assert len(pictures) > 60
    assert not alerts(pictures).any()
    assert alerts(pictures, "paper").any()


@pytest.mark.parametrize("number", [0, 4, 6, 8])
@pytest.mark.parametrize("snr_db", [10.0, 16.0, 19.0])
def test_noise_in_flight_alerts_within_300_ms(number, snr_db):
    """At and below the threshold of FM reception, from one picture on; six frames of 50 ms."""
    link = AnalogVideo(snr_db, seed=number, dropouts=0.0)
    pictures = [
        link.apply(p, k) if k >= ONSET else p for k, p in enumerate(flown(number)[: ONSET + 10])
    ]
    raised = alerts(pictures)
    assert not raised[:ONSET].any()
    assert raised[ONSET : ONSET + 7].any()


@pytest.mark.parametrize("number", [1, 5, 7, 8])
def test_analog_flight_with_a_good_link_is_no_alert(number):
    """26 dB, the worst that is called usable; fades of a few lines now and then are part of it."""
    link = AnalogVideo(26.0, seed=number)
    assert not alerts([link.apply(picture, k) for k, picture in enumerate(flown(number))]).any()


@pytest.mark.parametrize("number", [0, 4, 6, 8])
def test_freeze_in_flight_alerts_within_300_ms(number):
    """The picture stays what it is from one frame on; six frames of 50 ms."""
    pictures = flown(number)[: ONSET + 10].copy()
    pictures[ONSET:] = pictures[ONSET - 1]
    raised = alerts(list(pictures))
    assert not raised[:ONSET].any()
    assert raised[ONSET : ONSET + 6].any()
