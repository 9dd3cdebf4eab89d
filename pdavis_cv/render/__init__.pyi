"""The names of this room, and the module of each: the only list of them."""
from .colours import (
    FULL_COLOUR_DOLP as FULL_COLOUR_DOLP,
    INVALID as INVALID,
    MASKED as MASKED,
    Picture as Picture,
    aop_bgr as aop_bgr,
    dolp_bgr as dolp_bgr,
    fade as fade,
    grey_bgr as grey_bgr,
    hatch as hatch,
)
from .layouts import (
    fan_sheet as fan_sheet,
    png_of as png_of,
    summary as summary,
    tendon_sheet as tendon_sheet,
)
from .legends import (
    DARK as DARK,
    LIGHT as LIGHT,
    Panel as Panel,
    Style as Style,
    aop_legend as aop_legend,
    bar_legend as bar_legend,
    caption as caption,
    even as even,
    panel as panel,
    stack as stack,
    tile as tile,
)
from .overlay import (
    HIDDEN_SIGMA_DEG as HIDDEN_SIGMA_DEG,
    events_on as events_on,
    fade_aop as fade_aop,
    known_aop as known_aop,
    reliable as reliable,
    scale_bar as scale_bar,
)
from .quantity import colour_bgr as colour_bgr, quantity_bgr as quantity_bgr
from .strips import Line as Line, chart as chart
from .tone import ToneCurve as ToneCurve
