"""Colour pictures of polarization, their legends, and sheets of several."""
from pdavis_cv._opencv import opencv
from pdavis_cv.render.chart import Line, chart
from pdavis_cv.render.colours import (
    FULL_COLOUR_DOLP,
    INVALID,
    Picture,
    aop_bgr,
    dolp_bgr,
    fade,
    grey_bgr,
)
from pdavis_cv.render.cyclic import cyclic_bgr
from pdavis_cv.render.layouts import (
    fan_sheet,
    png_of,
    quad_picture,
    summary,
    tendon_sheet,
)
from pdavis_cv.render.legends import (
    DARK,
    LIGHT,
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
    draw_scale_bar,
    events_on,
    reliable,
    scale_bar,
)
from pdavis_cv.render.polar import draw_polarization
from pdavis_cv.render.quantity import quantity_bgr
from pdavis_cv.render.sheet import Panel, PanelSheet
from pdavis_cv.render.tone import ToneCurve

__all__ = [
    "DARK",
    "FULL_COLOUR_DOLP",
    "INVALID",
    "LIGHT",
    "Line",
    "Panel",
    "PanelSheet",
    "Picture",
    "Style",
    "ToneCurve",
    "aop_bgr",
    "aop_legend",
    "bar_legend",
    "caption",
    "chart",
    "cyclic_bgr",
    "dolp_bgr",
    "draw_polarization",
    "draw_scale_bar",
    "even",
    "events_on",
    "fade",
    "fan_sheet",
    "grey_bgr",
    "opencv",
    "panel",
    "png_of",
    "quad_picture",
    "quantity_bgr",
    "reliable",
    "scale_bar",
    "stack",
    "summary",
    "tendon_sheet",
    "tile",
]
