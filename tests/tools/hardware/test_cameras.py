"""The camera files become records, agree with the lens that the kit flies with, or give one
sentence.
"""

import math
import tomllib

import pytest
import tomli_w

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import shipped_path
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.tools.hardware.cameras import load_camera


def load(folder, spoil, camera="analog"):
    path = shipped_path(f"hardware/camera_{camera}.toml", "")
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    spoil(table)
    (folder / "mine.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    return load_camera(folder / "mine.toml")


def test_analog_camera_has_the_papers_numbers():
    """Paper, hardware section: 9 g, 640 x 480 at 20 Hz, analog at 5.725 GHz."""
    camera = load_camera()
    assert (camera.mass_g, camera.image.width_px, camera.image.height_px, camera.image.rate_hz) == (
        9.0,
        640,
        480,
        20.0,
    )
    assert camera.name == "RunCam Spotter" and "5.725 GHz" in camera.link


def test_analog_lens_is_the_one_that_the_kit_flies_with():
    """The hall's flights have a focal length of 0.62 image widths; 77.8 deg says so to a
    thousandth.
    """
    image = load_camera().image
    lens = PinholeCamera.from_fov_deg(image.width_px, image.height_px, image.fov_deg)
    assert lens.fx == pytest.approx(fpv_camera(640, 480).fx, rel=1e-3)


def test_digital_camera_has_the_data_sheets_numbers():
    """Arducam's data sheet of the B0196: 3264 x 2448 at 15 a second, 62.2 deg across and 48.8 deg
    high. Square pixels make 48.7 deg of the width's angle; holes in a square of 28 mm are 28 *
    sqrt(2) mm apart across.
    """
    camera = load_camera("digital")
    image = camera.image
    lens = PinholeCamera.from_fov_deg(image.width_px, image.height_px, image.fov_deg)
    high_deg = 2.0 * math.degrees(math.atan(0.5 * image.height_px / lens.fy))
    assert (image.width_px, image.height_px, image.rate_hz) == (3264, 2448, 15.0)
    assert high_deg == pytest.approx(48.8, abs=0.3)
    (a, b, *_) = camera.mount.holes_mm
    assert math.dist(a, b) == pytest.approx(28.0)


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda t: t.update(mass_g=-9.0), "mass_g"),
        (lambda t: t.pop("mass_g"), "missing key 'mass_g'"),
        (lambda t: t.update(mass_kg=0.009), "mass_kg"),
        (lambda t: t["image"].update(fov_deg=190.0), "fov_deg"),
        (lambda t: t["image"].update(width_px=640.5), "width_px"),
        (lambda t: t["mount"].update(kind="glue"), "cheeks, plate"),
        (lambda t: t["mount"].update(holes_mm=[]), "at least one hole"),
        (lambda t: t["mount"].update(holes_mm=[[0.0, 12.0]]), "above or below"),
        (lambda t: t["supply"].update(high_v=3.0), "high_v"),
        (lambda t: t["power_filter"].update(esr_ohm="low"), "esr_ohm"),
        (lambda t: t["power_filter"].update(damping_ohm=3.0), "a voltage drop below 10 %"),
    ],
)
def test_wrong_camera_is_one_sentence(tmp_path, spoil, text):
    """One value of the shipped file at a time; the sentence names file and value."""
    with pytest.raises(InputError, match=r"mine\.toml") as error:
        load(tmp_path, spoil)
    assert text in str(error.value) and "\n" not in str(error.value)


def test_missing_camera_is_named():
    """A name that is neither a kit's camera nor a file."""
    with pytest.raises(FileNotFoundError, match="thermal"):
        load_camera("thermal")
