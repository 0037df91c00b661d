"""renderers: a Gaussian scene and a camera -> an image, three ways; `scene/render.py` chooses."""
