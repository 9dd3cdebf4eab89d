"""Colour pictures of polarization, their legends, and sheets of several."""
from pdavis_cv._opencv import opencv
from pdavis_cv.render.chart import Line, chart
from pdavis_cv.render.colours import (
    FULL_COLOUR_DOLP,
    INVALID,
    MASKED,
    Picture,
    aop_bgr,
    dolp_bgr,
    fade,
    grey_bgr,
    hatch,
)
from pdavis_cv.render.layouts import (
    fan_sheet,
    png_of,
    summary,
    tendon_sheet,
)
from pdavis_cv.render.legends import (
    DARK,
    LIGHT,
    Panel,
    Style,
    aop_legend,
    bar_legend,
    caption,
    even,
    panel,
    stack,
    tile,
)
from pdavis_cv.render.overlay import (
    HIDDEN_SIGMA_DEG,
    events_on,
    fade_aop,
    known_aop,
    reliable,
    scale_bar,
)
from pdavis_cv.render.quantity import quantity_bgr
from pdavis_cv.render.tone import ToneCurve

__all__ = [
    "DARK",
    "FULL_COLOUR_DOLP",
    "HIDDEN_SIGMA_DEG",
    "INVALID",
    "LIGHT",
    "MASKED",
    "Line",
    "Panel",
    "Picture",
    "Style",
    "ToneCurve",
    "aop_bgr",
    "aop_legend",
    "bar_legend",
    "caption",
    "chart",
    "dolp_bgr",
    "even",
    "events_on",
    "fade",
    "fade_aop",
    "fan_sheet",
    "grey_bgr",
    "hatch",
    "known_aop",
    "opencv",
    "panel",
    "png_of",
    "quantity_bgr",
    "reliable",
    "scale_bar",
    "stack",
    "summary",
    "tendon_sheet",
    "tile",
]
