"""Maps of equal steps, tone curves, overlays, charts and sheets."""
import numpy as np
import pytest
import reference

from pdavis_cv import PolarFrame, render
from pdavis_cv.events import EVENT_DTYPE

cv2 = pytest.importorskip("cv2")


def lab(bgr):
    """CIELAB by OpenCV, an independent conversion."""
    return cv2.cvtColor(np.float32(bgr)[None] / 255, cv2.COLOR_BGR2Lab)[0]


def light(aop, dolp=0.5, s0=40.0, shape=(20, 30), **facts):
    angles = np.deg2rad([0, 45, 90, 135])[:, None, None]
    quad = s0 / 2 * (1 + dolp * np.cos(2 * (aop - angles)))
    return PolarFrame(np.broadcast_to(quad, (4, *shape)), **facts)


ANGLES = np.linspace(0, np.pi, 180, endpoint=False)


def grey_of(curve, intensity):
    return curve.bgr(intensity, invalid=(0, 0, 0))[..., 0]


def count_marks(sheet):
    """Pixels of either colour of what is not valid."""
    return sum(np.count_nonzero((sheet == colour).all(-1)) for colour in render.INVALID)


def oklab(bgr):
    """Oklab of linear light, by Ottosson's published matrices."""
    value = bgr[..., ::-1] / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    cones = linear @ np.array([[0.4122214708, 0.5363325363, 0.0514459929],
                               [0.2119034982, 0.6806995451, 0.1073969566],
                               [0.0883024619, 0.2817188376, 0.6299787005]]).T
    return np.cbrt(cones) @ np.array([[0.2104542553, 0.7936177850, -0.0040720468],
                                      [1.9779984951, -2.4285922050, 0.4505937099],
                                      [0.0259040371, 0.7827717662, -0.8086757660]]).T


def without_green(bgr):
    """Deuteranopia by Machado, Oliveira and Fernandes (2009), in linear light."""
    value = bgr[..., ::-1] / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.array([[0.367322, 0.860646, -0.227968],
                                      [0.280085, 0.672501, 0.047413],
                                      [-0.011820, 0.042940, 0.968881]]).T, 0, 1)
    return 255 * np.where(seen <= 0.0031308, 12.92 * seen,
                          1.055 * seen ** (1 / 2.4) - 0.055)[..., ::-1]


def test_steps_of_the_even_map_look_equal_and_those_of_hsv_do_not():
    even, hsv = (render.aop_bgr(ANGLES[None], colours=colours)[0]
                 for colours in ("even", "hsv"))
    step, hsv_step = (np.linalg.norm(np.roll(v, -6, 0) - v, axis=1)
                      for v in (oklab(even), oklab(hsv)))
    assert step.max() / step.min() < 1.2
    assert hsv_step.max() / hsv_step.min() > 3
    assert lab(even)[:, 0].min() == pytest.approx(51, abs=1)
    assert lab(even)[:, 0].max() == pytest.approx(79, abs=1)
    assert np.ptp(lab(hsv)[:, 0]) > 60


@pytest.mark.parametrize("eyes", [lambda bgr: bgr, without_green])
def test_angles_30_degrees_apart_differ_to_all_eyes(eyes):
    seen = lab(eyes(render.aop_bgr(ANGLES[None])[0].astype(float)))
    apart = np.abs((np.subtract.outer(np.arange(180), np.arange(180)) + 90) % 180 - 90)
    distance = np.linalg.norm(seen[:, None] - seen, axis=-1)
    assert distance[apart >= 30].min() > 10


def test_the_angle_can_be_read_back_from_its_colour():
    angles = np.random.default_rng(0).uniform(0, np.pi, 500)
    table = oklab(render.aop_bgr(np.linspace(0, np.pi, 720, endpoint=False)[None])[0])
    seen = oklab(render.aop_bgr(angles[None])[0])
    nearest = np.linalg.norm(seen[:, None] - table, axis=-1).argmin(1) * np.pi / 720
    error = np.abs((nearest - angles + np.pi / 2) % np.pi - np.pi / 2)
    assert np.rad2deg(error).max() < 1


def test_an_angle_that_its_method_does_not_know_is_hidden():
    quad = light(0.3, 0.5).quad
    variance = np.full((4, 20, 30), 1e-4)
    variance[:, :5] = 400
    frame = PolarFrame(quad, variance=variance)
    hidden = frame.sigma_aop > np.deg2rad(render.HIDDEN_SIGMA_DEG)
    assert hidden[:5].all()
    assert not hidden[5:].any()
    picture = render.aop_bgr(frame.aop, frame.valid)
    want = np.where(hidden[..., None], 7, picture)
    render.fade_aop(picture, frame, ground=7)
    np.testing.assert_array_equal(picture, want)


@pytest.mark.parametrize("colours", ["even", "hsv"])
def test_the_wheel_shows_each_angle_in_the_colour_that_the_data_have(colours):
    radius = 200
    wheel = render.aop_legend(radius, colours=colours)
    angles = np.deg2rad(np.arange(1, 180))
    x = np.rint(radius - 0.5 + 150 * np.cos(angles)).astype(int)
    y = np.rint(radius - 0.5 - 150 * np.sin(angles)).astype(int)
    there = np.arctan2(radius - 0.5 - y, x - radius + 0.5)
    np.testing.assert_array_equal(
        wheel[y, x], render.aop_bgr(there[None], colours=colours)[0])
    # Within the 0.2 degrees that a pixel of the wheel spans, the angle's own colour.
    difference = wheel[y, x].astype(int) - render.aop_bgr(
        angles[None], colours=colours)[0]
    assert np.max(np.abs(difference)) <= 6


def test_zero_and_a_half_turn_have_one_colour():
    both = render.aop_bgr(np.array([[0, np.pi, -np.pi]]))[0]
    assert (both == both[0]).all()


def test_a_tone_curve_shows_both_halves_of_a_2000_to_1_scene():
    rng = np.random.default_rng(0)
    dim, bright = rng.uniform(0.5, 1, (40, 40)), rng.uniform(1000, 2000, (40, 40))
    curve = render.ToneCurve.of([np.hstack((dim, bright))])
    grey_dim, grey_bright = grey_of(curve, dim), grey_of(curve, bright)
    assert np.ptp(grey_dim) > 12
    assert np.ptp(grey_bright) > 12
    assert grey_dim.max() < grey_bright.min()
    linear = render.grey_bgr(dim, 2000.0)
    assert np.ptp(linear) == 0


@pytest.mark.parametrize("knee", [1e-5, 0.01, 1.0, 50.0])
def test_a_tone_curve_is_the_formula_over_six_decades(knee):
    value = np.geomspace(1e-6, 2.0, 4000)
    want = 255 * np.arcsinh(np.minimum(value, 1) / knee) / np.arcsinh(1 / knee)
    got = grey_of(render.ToneCurve(1.0, knee), value[None])[0]
    assert np.max(np.abs(got - want)) < 0.6


def test_a_tone_curve_cannot_flicker():
    curve = render.ToneCurve(100.0, 1.0)
    still = np.linspace(0, 100, 50)
    for flash in (0.0, 50.0, 1e6, np.nan):
        image = np.concatenate((still, [flash]))[None]
        np.testing.assert_array_equal(
            grey_of(curve, image)[0, :50], grey_of(curve, still))
    values = grey_of(curve, np.linspace(0, 120, 1000))
    assert np.all(np.diff(values.astype(int)) >= 0)
    assert (values[0], values[-1]) == (0, 255)
    with pytest.raises(ValueError, match="knee must be positive"):
        render.ToneCurve(1.0, 0.0)
    with pytest.raises(ValueError, match="log excludes a knee"):
        render.ToneCurve(1.0, 0.5, log=True)
    with pytest.raises(ValueError, match="images must hold a positive pixel"):
        render.ToneCurve.of([np.zeros((2, 2))])


@pytest.mark.parametrize("eyes", [lambda bgr: bgr, without_green])
def test_no_grey_or_degree_has_a_colour_of_pixels_that_are_not_valid(eyes):
    steps = np.linspace(0, 1, 256)[None]
    data = oklab(eyes(np.hstack((
        render.grey_bgr(steps, 1.0), render.dolp_bgr(steps)))[0].astype(float)))
    marks = oklab(eyes(np.array(render.INVALID, float)))
    away = np.linalg.norm(data[:, None] - marks, axis=-1)
    assert away.min() > 0.03    # black is 1 from white
    assert np.linalg.norm(marks[0] - marks[1]) > 0.15   # the stripes are seen


def test_a_tone_curve_whitens_what_is_too_bright_and_marks_what_is_too_dark():
    value = np.array([[0.01, 0.01, 20.0, 20.0, 60.0]])
    valid = np.array([[True, False, True, False, True]])
    curve = render.ToneCurve(60.0, saturated=18.0)
    seen = curve.seen(value, valid)[0]
    assert seen[[0, 2, 3, 4], 0].tolist() == [0, 85, 255, 255]
    assert reference.hatched(seen[None])[0].tolist() == [False, True] + 3 * [False]
    assert reference.hatched(render.ToneCurve(60.0).seen(value, valid))[0].tolist() == [
        False, True, False, True, False]
    with pytest.raises(ValueError, match="saturated must be positive"):
        render.ToneCurve(60.0, saturated=0.0)


def test_events_whiten_and_blacken_their_own_pixels():
    events = np.zeros(6, EVENT_DTYPE)
    events["x"], events["y"] = [3, 3, 5, 9, 9, 40], [2, 2, 4, 1, 1, 2]
    events["p"] = [1, 1, 0, 1, 0, 1]
    picture = render.events_on((8, 12), events, step=128)
    assert picture[2, 3].tolist() == [255] * 3
    assert picture[4, 5].tolist() == [64] * 3
    assert picture[1, 9].tolist() == [128] * 3  # ON and OFF cancel
    assert np.count_nonzero(picture != 128) == 6
    shifted = render.events_on((8, 12), events, origin=(1, 1), step=128)
    assert shifted[1, 2].tolist() == [255] * 3


def test_fading_and_masking_follow_reliability():
    picture = render.aop_bgr(np.full((1, 5), 1.0))
    faded = picture.copy()
    render.fade(faded, [[0, 0.2, np.nan, 0.4, 0]], np.array([[1, 1, 1, 1, 0]], bool),
                top=0.4, ground=20)
    assert faded[0, 0].tolist() == faded[0, 2].tolist() == [20] * 3
    assert np.abs(faded[0, 1] - (picture[0, 1] + 20.0) / 2).max() <= 0.5
    np.testing.assert_array_equal(faded[0, 3:], picture[0, 3:])
    frame = PolarFrame(light(0.3, 0.2).quad, variance=np.full((4, 20, 30), 1e-4))
    assert render.reliable(frame, least_dolp=0.1).all()
    assert not render.reliable(frame, least_dolp=0.3).any()
    limit = float(np.rad2deg(frame.sigma_aop[0, 0]))
    assert render.reliable(frame, most_sigma_deg=limit * 1.01).all()
    assert not render.reliable(frame, most_sigma_deg=limit * 0.99).any()
    with pytest.raises(ValueError, match="needs a method that knows its variance"):
        render.reliable(light(0.3), most_sigma_deg=5)


MARK = (10, 77, 200)
"""A colour that neither text nor legends have."""


@pytest.mark.parametrize("ground", [0, 255])
def test_the_wheel_of_a_faded_angle_shows_angle_and_degree(ground):
    radius = 60
    wheel = render.aop_legend(radius, ground, faded=True)
    for dolp in (0.2, 0.5, 0.9):
        for a in np.deg2rad((10, 80, 150)):
            x = int(radius + dolp * radius * np.cos(a))
            y = int(radius - dolp * radius * np.sin(a))
            up, across = radius - 0.5 - y, x + 0.5 - radius
            want = render.aop_bgr(np.arctan2([[up]], [[across]]))
            render.fade(want, [[np.hypot(up, across)]], top=radius, ground=ground)
            np.testing.assert_array_equal(wheel[y, x], want[0, 0])


def test_a_light_sheet_is_dark_text_on_white():
    picture = np.full((30, 40, 3), MARK, np.uint8)
    sheets = {style: render.tile([render.panel(
        picture, "AoP", legend="faded", scale=4, style=style)], columns=1, title="t",
        style=style) for style in (render.DARK, render.LIGHT)}
    for style, sheet in sheets.items():
        assert np.median(sheet[:20]) == style.ground
        assert abs(int(sheet[:20].astype(int).sum(-1).max() if style is render.DARK
                       else sheet[:20].astype(int).sum(-1).min()) / 3 - style.ink) < 60
        assert (sheet[-4:] == style.ground).all()
    dark, light = sheets.values()
    assert dark.shape == light.shape
    np.testing.assert_array_equal((dark == MARK).all(-1), (light == MARK).all(-1))


@pytest.mark.parametrize("width", [346, 692, 1384, 2448])
def test_text_and_legends_are_as_large_as_the_picture_needs(width):
    picture = np.full((200, width, 3), MARK, np.uint8)
    style = render.DARK.sized(width)
    sheet = render.panel(picture, "HIH", legend="faded", style=style)
    top = np.flatnonzero((sheet == MARK).all(-1).any(1))[0]
    text = np.flatnonzero((sheet[:top] > 128).any((1, 2)))
    assert (np.ptp(text) + 1) / width == pytest.approx(10 / 346, rel=0.25)
    coloured = np.ptp(sheet[top + 200:].astype(int), axis=-1).max(0) > 40
    assert np.count_nonzero(coloured) / width == pytest.approx(70 / 346, rel=0.2)


@pytest.mark.parametrize("legend", ["aop", "faded", "hsv", "dolp", "grey"])
def test_a_legend_says_how_pixels_look_that_are_not_valid(legend):
    picture = np.full((20, 300, 3), MARK, np.uint8)
    sheet = render.panel(picture, "t", legend=legend)
    assert count_marks(sheet) == 100


@pytest.mark.parametrize("shape", [(6, 7), (40, 9), (9, 300), (131, 86)])
def test_panels_of_any_size_stand_in_one_line(shape):
    picture = np.full((*shape, 3), MARK, np.uint8)
    scale = max(1, -(-240 // shape[1]))
    sheet = render.tile([
        render.panel(picture, "S0", legend="grey", end="1234 DN/ms", scale=scale),
        render.panel(picture, "AoP", legend="faded", scale=scale),
        render.panel(picture, "DoLP", legend="dolp", scale=scale)], columns=3,
        title="t")
    seen = (sheet == MARK).all(-1)
    rows = np.flatnonzero(seen.any(1))
    assert len(rows) == rows[-1] - rows[0] + 1 == scale * shape[0]
    assert (seen[rows].sum(1) == 3 * scale * shape[1]).all()
    starts = np.flatnonzero(np.diff(seen[rows[0]].astype(int)) == 1)
    assert len(starts) == 3
    assert starts[1] - starts[0] == starts[2] - starts[1]


def test_a_scale_bar_has_its_length_and_leaves_the_picture_as_it_was():
    ground = np.full((120, 300, 3), 99, np.uint8)
    bar = render.scale_bar(ground, 0.74)
    assert (ground == 99).all()
    row = bar[120 - 10]
    assert np.count_nonzero((row == 235).all(-1)) == round(50 / 0.74)  # 50 um
    with pytest.raises(ValueError, match="pixel_um must be positive"):
        render.scale_bar(ground, 0)


def test_a_chart_draws_its_trace_where_the_values_are():
    t = np.linspace(0, 2, 200)
    line = render.Line(t, t / 2, (0, 255, 255))
    picture = render.chart([line], (120, 300), span_s=(0, 2), limits=(0, 1))
    yellow = np.argwhere((picture[:, :, 1] > 150) & (picture[:, :, 0] < 100))
    slope = np.polyfit(yellow[:, 1], yellow[:, 0], 1)[0]
    assert slope == pytest.approx(-(120 - 42) / (300 - 52), rel=0.05)
    half = render.chart([line], (120, 300), span_s=(0, 2), limits=(0, 1), now_s=1)
    drawn = np.argwhere((half[:, :, 1] > 150) & (half[:, :, 0] < 100))
    assert drawn[:, 1].max() <= 44 + 248 // 2 + 1
    gap = render.Line(t, np.where(np.abs(t - 1) < 0.2, np.nan, 0.5), (0, 255, 255))
    broken = render.chart([gap], (120, 300), span_s=(0, 2), limits=(0, 1))
    assert not (broken[:, 44 + 124, 1] > 150).any()
    with pytest.raises(ValueError, match="axes must not be empty"):
        render.chart([line], (120, 300), span_s=(0, 0), limits=(0, 1))


def test_sheets_of_odd_images_have_even_sides():
    held = light(0.3, shape=(31, 43), t_us=0, provenance={"method": "frames"})
    fused = light(0.5, shape=(31, 43), t_us=0, provenance={"method": "cf"})
    second = light(0.5, shape=(77, 91), t_us=0)

    def grey(plane, valid):
        return render.grey_bgr(plane, 30, valid)

    events = render.events_on((31, 43), np.zeros(0, EVENT_DTYPE))
    below = render.chart([], (101, 333), span_s=(0, 1), limits=(0, 1))
    for sheet in (
            render.fan_sheet([("frames", held, grey), ("cf", fused, grey),
                              ("Sony", second, grey)], scale=2),
            render.tendon_sheet(held, events, fused, below, grey=grey, top=0.6)):
        assert sheet.dtype == np.uint8
        assert sheet.shape[0] % 2 == sheet.shape[1] % 2 == 0


def test_a_time_that_passes_leaves_the_width_of_its_picture():
    picture = np.zeros((30, 20, 3), np.uint8)
    widths = {render.tile([picture], columns=1, title=f"a recording   t = {t} s").shape
              for t in ("0.1111", "0.2000", "0.8888")}
    assert len(widths) == 1


def test_the_fan_sheet_shows_the_angle_of_each_row():
    held, fused = light(0.3), light(1.2)
    sheet = render.fan_sheet(
        [(name, frame, lambda p, v: render.grey_bgr(p, 30, v))
         for name, frame in (("frames", held), ("cf", fused))])
    for angle in (0.3, 1.2):
        colour = render.aop_bgr(np.array([[angle]]))[0, 0]
        assert np.count_nonzero((sheet == colour).all(-1)) >= 600


def test_angles_that_are_masked_do_not_look_as_if_they_were_not_valid():
    weak, valid = light(0.3, 0.1), np.arange(600).reshape(20, 30) >= 30
    image = PolarFrame(weak.quad, valid=valid)
    sheet = render.fan_sheet([("a", image, lambda p, v: render.grey_bgr(p, 30))],
                             least_dolp=0.2)
    # the first row of AoP and of DoLP, and two legends of 10 x 10
    assert count_marks(sheet) == 2 * 30 + 2 * 100
    assert np.count_nonzero((sheet == render.MASKED).all(-1)) >= 19 * 30
