"""Moving figures of the labs: a drawing function or pictures -> a looping GIF below a cell.

    display(moving_figure(figure, draw, 60, 0.1, "In words: ..."))

GIF is what every notebook page shows, without a player, a kernel or JavaScript.

    figure_with_sliders(draw, "In words: ...", (8.0, 5.0), mass_g=Slider("mass [g]", 50, 400, 150))

The picture is an ordinary PNG, so it stays where nothing can be moved; sliders need ipywidgets.
"""

import io
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from falconwing_kit.core.checks import Array, InputError

if TYPE_CHECKING:
    from IPython.display import Image
    from matplotlib.figure import Figure

LARGEST = 1_000_000  # of one animation [bytes]
COLOURS = (64, 32, 16)  # as many as fit into LARGEST
LARGE = 100_000  # picture, of which a quarter of the pixels is enough for a palette [px]
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#FFFFFF")  # of the labs' figures


def moving_figure(
    figure: "Figure",
    draw: Callable[[int], object],
    count: int,
    seconds: float,
    words: str,
    width: int | None = None,
) -> "Image":
    """Draw a figure many times and show the pictures as a film.

    Args:
        figure: made by `matplotlib.figure.Figure`, so that it is not shown by itself.
        draw: changes the figure to picture number 0, 1, ...
        count: of the pictures.
        seconds: that each picture stays.
        words: what is seen, for those who cannot see it.
        width: at which it is shown [px]; that of the pictures if None.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas, pictures = FigureCanvasAgg(figure), []
    for number in range(count):
        draw(number)
        canvas.draw()
        figure.set_layout_engine("none")  # arranged once: quicker, and nothing jumps
        pictures.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return moving_pictures(pictures, seconds, words, width)


def moving_pictures(
    pictures: Sequence[Any], seconds: float, words: str, width: int | None = None
) -> "Image":
    """Show pictures as a film.

    Args:
        pictures: each (H, W, 3) or, in grey, (H, W), uint8, all of one size.
        seconds: that each stays.
        words: what is seen, for those who cannot see it.
        width: at which it is shown [px]; that of the pictures if None.
    """
    from IPython.display import Image

    data = gif(pictures, seconds)
    return Image(data, format="gif", alt=words, width=width or np.shape(pictures[0])[1])


def gif(pictures: Sequence[Any], seconds: float) -> bytes:
    """An endless GIF of at most LARGEST bytes: fewer colours, then fewer pictures until it fits.

    Args:
        pictures: each (H, W, 3) or (H, W), uint8, at least one, all of one size.
        seconds: that each stays, in steps of 0.01 s.

    Raises:
        InputError: there is none, or their sizes differ.
    """
    from PIL import Image

    if not len(pictures):
        raise InputError("pictures: expected at least one, got none")
    shapes = {np.shape(each)[:2] for each in pictures}
    if len(shapes) > 1:
        raise InputError(
            f"pictures: expected all of one size, got {' and '.join(map(str, sorted(shapes)))}"
        )
    images = [Image.fromarray(np.asarray(each, np.uint8)).convert("RGB") for each in pictures]
    while True:
        for colours in COLOURS:
            data = _encode(images, seconds, colours)
            if len(data) <= LARGEST:
                return data
        images, seconds = images[::2], 2.0 * seconds


def _encode(images: Sequence[Any], seconds: float, colours: int) -> bytes:
    from PIL import Image

    some = np.unique(np.linspace(0, len(images) - 1, 12).astype(int))  # share one palette
    shown = np.array([np.asarray(images[number]) for number in some])
    lines = _lines_in(shown)
    # Of large pictures a quarter of the pixels, another one in the next: what stands is seen whole.
    step = 2 if images[0].width * images[0].height > LARGE else 1
    parts = [
        each[k % step :: step, k // 2 % step :: step].reshape(-1, 3) for k, each in enumerate(shown)
    ]
    # As many for each colour that thin lines have, so that no line loses its own.
    parts += [np.full((max(len(parts[0]) // 4, 1), 3), line, np.uint8) for line in lines]
    palette = Image.fromarray(np.concatenate(parts)[None]).quantize(colours, kmeans=2)
    few = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in images]
    buffer = io.BytesIO()
    few[0].save(
        buffer,
        "GIF",
        save_all=True,
        append_images=few[1:],
        duration=round(1000.0 * seconds),
        loop=0,
    )
    return buffer.getvalue()


def _lines_in(pixels: Any) -> list[tuple[int, ...]]:
    """Those of LINES that occur, as RGB; any other would only tint a photograph."""
    planes = np.ascontiguousarray(np.moveaxis(pixels, -1, 0))
    lines = [tuple(int(colour[k : k + 2], 16) for k in (1, 3, 5)) for colour in LINES]
    return [line for line in lines if _near(planes, line).sum() >= 8]


def _near(planes: Any, colour: Sequence[int]) -> Any:
    """Which pixels are less than 6 off a colour."""
    near = np.ones(planes.shape[1:], bool)
    for plane, value in zip(planes, colour, strict=True):
        near &= (plane >= max(value - 5, 0)) & (plane <= min(value + 5, 255))
    return near


@dataclass(frozen=True)
class Slider:
    """A number that a reader may move.

    Attributes:
        label: with its unit.
        low, high: its ends.
        start: at first, and for good where there are no sliders.
        step: between neighbouring values.
    """

    label: str
    low: float
    high: float
    start: float
    step: float = 1.0


def figure_with_sliders(
    draw: Callable[..., object], words: str, size: tuple[float, float], **sliders: Slider
) -> None:
    """Show a figure, and above it a slider for each number that `draw` takes.

    Without ipywidgets, and on a page that was rendered once, the figure at the start stays.

    Args:
        draw: draw(figure, **values) on an empty figure of matplotlib.
        words: what is seen, for those who cannot see it.
        size: of the figure [inch].
        sliders: by the name of the number.
    """
    from IPython.display import display

    values = {name: each.start for name, each in sliders.items()}
    first = _drawn(draw, values, words, size)  # which may stop: then no slider stands alone
    box, parts = _slider_box(sliders, words)
    if box:
        display(box, raw=True)
    else:
        said = ", ".join(f"{each.label} = {each.start:g}" for each in sliders.values())
        print(f"to move {said}: install ipywidgets (pip install ipywidgets) and start again")
    shown = display(first, display_id=True)

    def moved(name: str, value: float) -> None:
        values[name] = value
        if shown is not None:  # None outside of a notebook
            shown.update(_drawn(draw, values, words, size))

    for name, slider in parts.items():
        slider.observe(lambda change, name=name: moved(name, float(change["new"])), names="value")


def _slider_box(
    sliders: dict[str, Slider], words: str
) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """What a notebook shows of the sliders, and the sliders; (None, {}) without ipywidgets."""
    with suppress(ImportError):
        from ipywidgets import FloatSlider, Layout, VBox

        parts = {
            name: FloatSlider(
                value=each.start, min=each.low, max=each.high, step=each.step,
                description=each.label, continuous_update=False,
                style={"description_width": "12em"}, layout=Layout(width="36em"),
            )
            for name, each in sliders.items()
        }  # fmt: skip
        bundle = dict(VBox(list(parts.values()))._repr_mimebundle_())
        bundle["text/plain"] = f"Sliders, in a running notebook. {words}"
        return bundle, parts
    return None, {}


def _drawn(
    draw: Callable[..., object], values: dict[str, float], words: str, size: tuple[float, float]
) -> "Image":
    from IPython.display import Image
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    draw(figure, **values)
    data = io.BytesIO()
    FigureCanvasAgg(figure).print_png(data)
    return Image(data.getvalue(), format="png", alt=words)


def plan_view(x: float, y: float, yaw: float, span: float = 0.7) -> Array:
    """Outline of the aircraft from above, to plot or fill: (2, N) [m].

    Args:
        x, y: its place [m], y to the left of x.
        yaw: of the nose, positive to the right of x [rad].
        span: of its wing [m]; larger than life where it must be seen.
    """
    half = [(0.45, 0.0), (0.30, 0.06), (0.16, 0.06), (0.16, 0.5), (-0.06, 0.5), (-0.06, 0.06)]
    half += [(-0.40, 0.04), (-0.40, 0.2), (-0.55, 0.2), (-0.55, 0.0)]
    other = [(a, -b) for a, b in reversed(half)]
    along, left = span * np.array(half + other).T
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([x + c * along + s * left, y - s * along + c * left])


def side_view(x: float, z: float, pitch: float, length: float = 0.6) -> Array:
    """Outline of the aircraft from its right side, nose to the right: (2, N) [m].

    Args:
        x, z: its place along the way and its height [m].
        pitch: positive nose up [rad].
        length: of the fuselage [m]; larger than life where it must be seen.
    """
    outline = [(0.5, 0.0), (0.35, 0.08), (0.1, 0.1), (-0.35, 0.04), (-0.42, 0.22), (-0.5, 0.22)]
    outline += [(-0.5, 0.0), (0.0, -0.05), (0.35, -0.07), (0.5, 0.0)]
    along, up = length * np.array(outline).T
    c, s = np.cos(pitch), np.sin(pitch)
    return np.array([x + c * along - s * up, z + s * along + c * up])
