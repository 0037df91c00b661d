"""Frame number of a fake camera: read from the bar code in its images."""

from falconwing_kit.tools.devices.cameras import CODE_BITS


def read_frame_number(pixels):
    """Number in the bar code of a fake camera's frame (H, W, 3), modulo 65536; robust to 12 dB."""
    height, width = pixels.shape[:2]
    strip = pixels[: height // 8].mean(axis=(0, 2))
    means = [
        strip[width * k // CODE_BITS + 1 : width * (k + 1) // CODE_BITS - 1].mean()
        for k in range(CODE_BITS)
    ]
    return sum(1 << k for k, mean in enumerate(means) if mean > 127.5)
