"""QR code: an address -> text blocks for a terminal, and SVG for the wall."""

import io


def qr_blocks(url: str) -> str:
    """The code as lines of half blocks, dark on light by the terminal's reverse video."""
    import segno

    text = io.StringIO()
    segno.make(url, micro=False).terminal(text, compact=True)
    return text.getvalue()


def qr_svg(url: str) -> bytes:
    """The code as an SVG with its quiet zone, black on white."""
    import segno

    data = io.BytesIO()
    segno.make(url, micro=False).save(data, kind="svg", scale=8, border=4, light="#fff")
    return data.getvalue()
