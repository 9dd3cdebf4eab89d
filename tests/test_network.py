import importlib
import pickle
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
import reference_network as reference
from ideal import rotating_polarizer
from streams import random_events

import pdavis_cv
from pdavis_cv import (
    EVENT_DTYPE,
    ApsFrame,
    Layout,
    LayoutError,
    WeightsError,
    WindowWarning,
    _kernels as kernels,
    fuse,
    recording_from_arrays,
)
from pdavis_cv.reconstruct.firenet import FireNet, Joint
from pdavis_cv.reconstruct.onnx import network_onnx
from pdavis_cv.reconstruct.runner import BACKENDS, chosen_backend, make_runner
from pdavis_cv.reconstruct.weights import Weights

NETWORKS = ("firenet", "joint")
METHODS = {"firenet": FireNet, "joint": Joint}
each_network = pytest.mark.parametrize("network", NETWORKS)
each_backend = pytest.mark.parametrize("backend", [
    pytest.param(name, marks=pytest.mark.skipif(
        find_spec(name) is None, reason=f"no {name}")) for name in BACKENDS])
THETAS = {"theta_on": 0.2, "theta_off": 0.3}


def made(network, shape=(6, 8), **parameters):
    parameters = {"window_us": 50_000, "weights": reference.random_weights(network),
                  **THETAS, **parameters}
    return METHODS[network](shape, **parameters)


def runner_of(weights, height, width, backend):
    """Return a runner; an OpenCV before 4.8 must be refused, and ends the test."""
    if backend == "cv2" and tuple(map(int, importlib.import_module(
            "cv2").__version__.split(".")[:2])) < (4, 8):
        with pytest.raises(ImportError, match=r"onnxruntime, or OpenCV 4\.8 or later"):
            make_runner(weights, height, width, backend)
        pytest.skip("this OpenCV is refused, as it should be")
    return make_runner(weights, height, width, backend)


# ---- the kernel -------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 2000])
@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (4, 6), (7, 5)])
@pytest.mark.parametrize("maps", [False, True])
def test_voxel_planes_match_reference(n, shape, maps):
    events = random_events(n, shape)
    events.flags.writeable = False
    thetas = np.random.default_rng(1).uniform(0.1, 0.3, (2, *shape)) if maps else (
        0.2, 0.3)
    on, off = (np.broadcast_to(theta, shape) for theta in thetas)
    steps = np.stack((-off, on), -1).astype(np.float32)
    planes = (shape[0] + 1) // 2, (shape[1] + 1) // 2
    out, seen = np.zeros((4, 5, *planes), np.float32), np.zeros(planes, np.uint8)
    args = (-1, 0, 1_000_000, steps, *shape, out, seen)
    assert kernels.voxel_planes(events, *args) == n
    want = reference.voxel_planes(events, 0, 1_000_000, on, off, shape)
    np.testing.assert_allclose(out, want, atol=1e-4)
    hit = np.zeros(planes, bool)
    hit[events["y"] // 2, events["x"] // 2] = True
    np.testing.assert_array_equal(seen, hit)


def test_voxel_planes_stop_at_what_does_not_belong():
    out, seen = np.zeros((4, 5, 1, 1), np.float32), np.zeros((1, 1), np.uint8)
    steps = np.ones((2, 2, 2), np.float32)
    for bad in [(5, 2, 0, 1), (5, 0, 2, 1), (5, 0, 0, 2), (3, 0, 0, 1), (9, 0, 0, 1)]:
        events = np.array([(4, 0, 0, 1), bad, (6, 0, 0, 1)], EVENT_DTYPE)
        assert kernels.voxel_planes(events, 0, 0, 9, steps, 2, 2, out, seen) == 1
    with pytest.raises(ValueError, match="sizes do not fit"):
        kernels.voxel_planes(events, 0, 0, 9, steps, 4, 2, out, seen)
    with pytest.raises(ValueError, match="steps do not fit"):
        kernels.voxel_planes(events, 0, 0, 9, steps[:1], 2, 2, out, seen)


# ---- the model --------------------------------------------------------------


def helper_model(weights, height, width):
    """The same graph, built by the onnx package."""
    onnx = pytest.importorskip("onnx")
    helper, arrays = onnx.helper, weights.arrays
    nodes, tensors = [], []

    def node(kind, inputs, outputs, **attributes):
        nodes.append(helper.make_node(
            kind, inputs, outputs, name=outputs[0], **attributes))
        return outputs[0]

    def conv(x, name, out, weight=None, bias=True):
        weight = arrays[f"{name}.weight"] if weight is None else weight
        names = [f"{name}.weight"] + [f"{name}.bias"] * bias
        values = [weight, arrays[f"{name}.bias"]] if bias else [weight]
        for one, value in zip(names, values, strict=True):
            tensors.append(onnx.numpy_helper.from_array(
                np.ascontiguousarray(value), one))
        side = weight.shape[-1]
        return node("Conv", [x, *names], [out], kernel_shape=[side] * 2,
                    pads=[side // 2] * 4, strides=[1, 1])

    def cell(i, x, h, out):
        node("Concat", [x, h], [f"g{i}.both"], axis=1)
        conv(f"g{i}.both", f"g{i}.gates", f"g{i}.sum")
        node("Sigmoid", [f"g{i}.sum"], [f"g{i}.gate"])
        node("Split", [f"g{i}.gate"], [f"g{i}.z", f"g{i}.r"], axis=1)
        node("Mul", [f"g{i}.r", h], [f"g{i}.reset"])
        node("Concat", [x, f"g{i}.reset"], [f"g{i}.kept"], axis=1)
        conv(f"g{i}.kept", f"g{i}.new", f"g{i}.fresh")
        node("Clip", [f"g{i}.fresh", "least", "most"], [f"g{i}.near"])
        node("Tanh", [f"g{i}.near"], [f"g{i}.value"])
        node("Sub", [f"g{i}.value", h], [f"g{i}.change"])
        node("Mul", [f"g{i}.z", f"g{i}.change"], [f"g{i}.part"])
        return node("Add", [h, f"g{i}.part"], [out])

    def residual(i, x):
        conv(x, f"r{i}.a", f"r{i}.one")
        node("Relu", [f"r{i}.one"], [f"r{i}.two"])
        conv(f"r{i}.two", f"r{i}.b", f"r{i}.three")
        node("Add", [x, f"r{i}.three"], [f"r{i}.four"])
        return node("Relu", [f"r{i}.four"], [f"r{i}.out"])

    for name, limit in (("least", -16), ("most", 16)):
        tensors.append(onnx.numpy_helper.from_array(np.float32(limit), name))
    conv("x", "head", "head.sum")
    y = node("Relu", ["head.sum"], ["head.out"])
    y = residual(2, cell(2, residual(1, cell(1, y, "h1", "g1")), "h2", "g2"))
    pred = arrays["pred.weight"]
    if weights.network == "joint":
        conv(y, "pred", "pred.inside", pred[:, :16])
        straight = np.zeros((6, 28, 1, 1), np.float32)
        straight[:, 20:] = pred[:, 16:]
        conv("x", "direct", "pred.direct", straight, bias=False)
        node("Add", ["pred.inside", "pred.direct"], ["y"])
    else:
        conv(y, "pred", "y")
    n, planes, out = (4, 5, 1) if weights.network == "firenet" else (1, 28, 6)
    state = (n, 16, height, width)
    sizes = {"x": (n, planes, height, width), "h1": state, "h2": state,
             "y": (n, out, height, width), "g1": state, "g2": state}
    values = [helper.make_tensor_value_info(name, 1, size)
              for name, size in sizes.items()]
    graph = helper.make_graph(nodes, weights.network, values[:3], values[3:], tensors)
    return helper.make_model(
        graph, ir_version=8, producer_name="pdavis_cv",
        opset_imports=[helper.make_opsetid("", 13)])


@each_network
def test_the_model_is_what_the_onnx_package_writes(network):
    onnx = pytest.importorskip("onnx")
    weights = reference.random_weights(network)
    ours = network_onnx(weights, 130, 173)
    model = onnx.load_from_string(ours)
    onnx.checker.check_model(model, full_check=True)
    assert model == helper_model(weights, 130, 173)


@each_network
@each_backend
@pytest.mark.parametrize(("size", "strength", "allowed"), [
    ((1, 1), 1, 1e-5), ((9, 7), 1, 1e-5), ((9, 7), 99, 1e-4)])
def test_every_backend_equals_the_plain_network_over_twenty_steps(
        network, backend, size, strength, allowed):
    weights = reference.random_weights(network, 3)
    run = runner_of(weights, *size, backend)
    random = np.random.default_rng(0)
    n, planes = (4, 5) if network == "firenet" else (1, 28)
    states = [np.zeros((n, 16, *size), np.float32) for _ in range(2)]
    plain = [state.astype(float) for state in states]
    for _ in range(20):
        x = random.poisson(0.4, (n, planes, *size)).astype(np.float32) - 0.4
        x *= strength
        y, *states = run(x, *states)
        want, *plain = reference.network_step(weights, x, *plain)
        for got, right in zip((y, *states), (want, *plain), strict=True):
            assert got.dtype == np.float32
            assert got.shape == right.shape
            np.testing.assert_allclose(got, right, atol=allowed * np.abs(right).max())


@each_network
@pytest.mark.skipif(not all(map(find_spec, BACKENDS)), reason="needs every backend")
def test_the_backends_agree_over_twenty_steps_with_the_packages_weights(network):
    weights, random = Weights.shipped(network), np.random.default_rng(0)
    runs = [runner_of(weights, 9, 7, backend) for backend in BACKENDS]
    n, planes = (4, 5) if network == "firenet" else (1, 28)
    states = [[np.zeros((n, 16, 9, 7), np.float32)] * 2 for _ in BACKENDS]
    for _ in range(20):
        x = random.poisson(0.4, (n, planes, 9, 7)).astype(np.float32) - 0.4
        (one, *states[0]), (other, *states[1]) = (
            run(x, *state) for run, state in zip(runs, states, strict=True))
        assert np.abs(one - other).max() <= 1e-5 * np.abs(one).max()


def test_the_quicker_backend_is_chosen_and_the_lack_of_both_is_said(monkeypatch):
    if find_spec("onnxruntime"):
        assert chosen_backend() == "onnxruntime"
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert chosen_backend() == "cv2"
    with pytest.raises(ImportError, match="pip install onnxruntime, or"):
        chosen_backend("onnxruntime")
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ImportError, match="onnxruntime or cv2"):
        Joint((4, 4), **THETAS)
    with pytest.raises(ValueError, match="backend must be one of auto, onnxruntime"):
        chosen_backend("torch")


def test_an_opencv_that_computes_something_else_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", SimpleNamespace(__version__="4.7.0-dev"))
    with pytest.raises(ImportError, match=r"onnxruntime, or OpenCV 4\.8 .*is 4\.7\.0"):
        make_runner(Weights.shipped("firenet"), 4, 4, "cv2")


# ---- the methods ------------------------------------------------------------


def by_place(log, shape):
    """(4, h, w) planes of a mosaic, 0 where an odd side has no pixel."""
    planes = np.zeros((4, (shape[0] + 1) // 2, (shape[1] + 1) // 2))
    for (row, column), place in reference.PLACE_OF.items():
        part = log[row::2, column::2]
        planes[place, :part.shape[0], :part.shape[1]] = part
    return planes


@each_network
@pytest.mark.parametrize("shape", [(1, 1), (5, 8), (6, 7)])
@pytest.mark.parametrize("unit", [0.2, None])
def test_a_method_equals_the_plain_one(network, shape, unit):
    weights = reference.random_weights(network, unit=unit)
    events = random_events(3000, shape)
    method = made(network, shape, weights=weights)
    want = reference.reconstruct(weights, events, shape, 50_000, (0.2, 0.3), 25)
    for k, light in enumerate(want):
        inside = (events["t"] >= k * 50_000) & (events["t"] < (k + 1) * 50_000)
        method.add_events(events[inside])
        got = method.read((k + 1) * 50_000)
        assert got.valid.all()
        assert got.variance is None
        value = by_place(np.exp(got.log_intensity), shape)
        exists = value > 0
        np.testing.assert_allclose(
            value[exists], np.maximum(light, 1e-3)[exists], rtol=3e-4, atol=1e-5)


@each_network
def test_packets_and_reading_leave_no_trace(network):
    events = random_events(4000, (6, 8))
    whole, parts = made(network), made(network)
    whole.add_events(events)
    for i in range(0, len(events), 37):
        parts.add_events(events[i:i + 37])
        t = int(events["t"][min(i + 36, len(events) - 1)])
        parts.read(t + 40_000 * (i % 3))
    last = 1_200_000
    np.testing.assert_array_equal(
        whole.read(last).log_intensity, parts.read(last).log_intensity)


@each_network
def test_a_snapshot_returns_to_the_same_bits(network):
    events = random_events(4000, (6, 8))
    method = made(network)
    method.add_events(events[:2000])
    kept = pickle.loads(pickle.dumps(method.snapshot()))
    copy = pickle.loads(pickle.dumps(method))
    method.add_events(events[2000:])
    want = method.read(1_000_000)
    again = made(network)
    again.restore(kept)
    for one in (again, copy):
        one.add_events(events[2000:])
        got = one.read(1_000_000)
        np.testing.assert_array_equal(got.log_intensity, want.log_intensity)
        np.testing.assert_array_equal(got.valid, want.valid)
    with pytest.raises(ValueError, match="other parameters: weights"):
        made(network, weights=reference.random_weights(network, 1)).restore(kept)


@each_network
def test_nothing_is_valid_before_an_event_and_a_window(network):
    method = made(network)
    assert not method.read(10**9).valid.any()
    method.add_events(np.array([(60_000, 3, 2, 1)], EVENT_DTYPE))
    assert not method.read(99_999).valid.any()
    got = method.read(100_000)
    assert got.valid.sum() == 4
    assert got.valid[2:4, 2:4].all()


@each_network
def test_a_long_silence_costs_no_steps_and_changes_nothing(network, monkeypatch):
    from pdavis_cv.reconstruct import firenet

    method, steps = made(network), []
    stepped = firenet._Recurrent._stepped
    monkeypatch.setattr(firenet._Recurrent, "_stepped", lambda *a: (
        steps.append(1), stepped(*a))[1])
    method.add_events(random_events(100, (6, 8), start_us=0, stop_us=40_000))
    soon = method.read(65 * 50_000).log_intensity
    late = method.read(10**15).log_intensity
    np.testing.assert_array_equal(soon, late)
    assert len(steps) == 65
    method.add_events(np.array([(10**15, 0, 0, 1)], EVENT_DTYPE))
    assert len(steps) == 65


@each_network
def test_what_cannot_be_is_refused_by_name(network):
    with pytest.raises(ValueError, match="window_us must be a whole number in 1000"):
        made(network, window_us=999)
    with pytest.raises(ValueError, match="scaling must be None or one of minimum"):
        made(network, scaling="max")
    with pytest.raises(ValueError, match="table must be given with scaling='table'"):
        made(network, scaling="table")
    with pytest.raises(ValueError, match=r"table must have shape \(4, 2, K\)"):
        made(network, scaling="table", table=np.zeros((4, 3)))
    with pytest.raises(ValueError, match="increase in its first row"):
        made(network, scaling="table", table=np.zeros((4, 2, 5)))
    other = NETWORKS[NETWORKS.index(network) - 1]
    with pytest.raises(ValueError, match=f"weights must be of network '{network}'"):
        made(network, weights=reference.random_weights(other))
    method = made(network)
    with pytest.raises(ValueError, match=r"event 1 at \(x=8, y=0, p=1\) lies outside"):
        method.add_events(np.array([(5, 0, 0, 1), (6, 8, 0, 1)], EVENT_DTYPE))
    with pytest.raises(ValueError, match="event 0 at t=4 comes after"):
        method.add_events(np.array([(4, 0, 0, 1)], EVENT_DTYPE))
    with pytest.raises(ValueError, match="frame must be 8x6"):
        method.add_frame(ApsFrame(np.ones((4, 4)), 10, 20))
    with pytest.raises(ValueError, match="t_us must not lie before"):
        method.read(0)


@each_network
def test_eight_threads_get_what_one_gets(network):
    events = random_events(2000, (6, 8))

    def run(_):
        method = made(network)
        method.add_events(events)
        return method.read(1_000_000).log_intensity

    want = run(0)
    with ThreadPoolExecutor(8) as pool:
        for got in pool.map(run, range(8)):
            np.testing.assert_array_equal(got, want)


# ---- the paper's calibrations -----------------------------------------------


def traces(method, events, until):
    values = []
    for t in range(50_000, until + 1, 50_000):
        method.add_events(events[(events["t"] >= t - 50_000) & (events["t"] < t)])
        values.append(np.exp(method.read(t).log_intensity))
    return np.array(values)


@each_network
def test_scalings_are_the_minimum_and_the_range_so_far(network):
    events = random_events(3000, (4, 4))
    plain, least, ranged = (
        traces(made(network, (4, 4), scaling=scaling), events, 1_000_000)
        for scaling in (None, "minimum", "normalise"))
    low = np.minimum.accumulate(plain, 0)
    high = np.maximum.accumulate(plain, 0)
    usable = (plain > 2e-3) & (low > 2e-3)
    want = np.maximum(plain - low, 1e-3)
    np.testing.assert_allclose(least[usable], want[usable], rtol=1e-3, atol=2e-4)
    want = np.maximum((plain - low) / np.maximum(high - low, 1e-3), 1e-3)
    np.testing.assert_allclose(ranged[usable], want[usable], rtol=5e-3, atol=5e-3)


def test_a_method_passes_its_intensity_through_the_table():
    events = random_events(3000, (4, 4))
    plain = traces(made("firenet", (4, 4)), events, 500_000)
    curve = np.linspace(-50, 50, 9)
    table = np.stack([np.stack((curve, scale * np.abs(curve)))
                      for scale in (1, 2, 3, 4)])
    got = traces(made("firenet", (4, 4), scaling="table", table=table), events, 500_000)
    positive = plain > 2e-3
    for (row, column), place in reference.PLACE_OF.items():
        here = np.zeros_like(positive)
        here[:, row::2, column::2] = True
        here &= positive
        want = np.interp(plain[here], *table[place])
        np.testing.assert_allclose(got[here], want, rtol=1e-4)


# ---- through fuse -----------------------------------------------------------


@each_network
def test_fuse_and_seeking_reach_a_network(network, tmp_path):
    assert network in pdavis_cv.METHODS
    recording, _ = rotating_polarizer(300, 0.5, size=(8, 12))
    parameters = {"method": network, "fps": 200, "window_us": 5000,
                  "weights": reference.random_weights(network)}
    images = list(fuse(recording, **parameters))
    assert images[-1].valid.all()
    assert np.isfinite(images[-1].quad).all()
    causal = list(fuse(recording, causal=True, **parameters))
    np.testing.assert_array_equal(images[50].quad, causal[50].quad)
    stream = fuse(recording, **parameters)
    for _ in range(30):
        next(stream)
    kept = stream.snapshot()
    want = next(stream).quad
    stream.rewind()
    stream.restore(kept)
    np.testing.assert_array_equal(next(stream).quad, want)
    np.testing.assert_array_equal(images[30].quad, want)
    part = list(fuse(recording, roi=(3, 1, 5, 4), **parameters))
    np.testing.assert_array_equal(part[40].quad, images[40].quad[:, 1:5, 3:8])


@pytest.mark.parametrize("turns", range(4))
def test_joint_sees_any_turned_sensor_alike(turns):
    # Turning the camera's cell relabels places: the network knows places only.
    recording, _ = rotating_polarizer(300, 0.4, size=(8, 8))
    events = np.concatenate([packet.events for packet in recording.packets()])
    layout = Layout.PDAVIS.rot90(turns)
    relabelled = recording_from_arrays(events, sensor_size=(8, 8), layout=layout)
    parameters = {"method": "joint", "window_us": 10_000, "times_us": [300_000],
                  "weights": reference.random_weights("joint"),
                  "demosaic": "superpixel"}
    one, = fuse(recording, **parameters)
    other, = fuse(relabelled, **parameters)
    np.testing.assert_allclose(other.dolp, one.dolp, rtol=1e-5)


def test_joint_refuses_a_layout_whose_opposites_lie_side_by_side():
    recording = recording_from_arrays(
        random_events(10, (4, 4)), sensor_size=(4, 4),
        layout=Layout((0, 90), (45, 135)))
    with pytest.raises(LayoutError, match="'joint' needs a layout in which 0 and 90"):
        fuse(recording, method="joint")


@pytest.mark.parametrize(("share", "warns"), [(1 / 5, True), (1 / 12, False)])
def test_windows_longer_than_an_eighth_of_the_period_are_warned_of(share, warns):
    period_us = 100_000  # 300 turns per minute, intensity once per half turn
    recording, _ = rotating_polarizer(300, 4.0, size=(8, 8), theta=(0.15, 0.15))
    events = np.concatenate([packet.events for packet in recording.packets()])
    method = made("joint", (8, 8), window_us=int(period_us * share))
    if not warns:
        method.add_events(events)
        return
    with pytest.warns(WindowWarning, match="longer than an eighth") as caught:
        method.add_events(events)
    assert len(caught) == 1


# ---- weights ----------------------------------------------------------------


@each_network
def test_weights_return_from_their_file(network, tmp_path):
    weights = reference.random_weights(network)
    weights.save(tmp_path / "w.npz")
    again = Weights.load(tmp_path / "w.npz")
    assert again.digest == weights.digest
    assert (again.network, again.unit) == (network, 0.2)
    assert again.parameters == {"firenet": 37_777, "joint": 41_222}[network]
    other = Weights(network, weights.arrays, None)
    assert other.digest != weights.digest


def test_damaged_and_foreign_weights_are_refused_by_name(tmp_path):
    path = tmp_path / "w.npz"
    weights = reference.random_weights("joint")
    weights.save(path)
    data = path.read_bytes()
    for cut in (0, 10, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:cut])
        with pytest.raises(WeightsError, match=r"w\.npz: not weights that pdavis_cv"):
            Weights.load(path)
    path.write_bytes(data[:5000] + bytes(500) + data[5500:])
    with pytest.raises(WeightsError, match=r"w\.npz"):
        Weights.load(path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(WeightsError, match="not weights that pdavis_cv wrote"):
        Weights.load(path)
    np.savez(path, about=np.array([{}], object))
    with pytest.raises(WeightsError, match="not weights that pdavis_cv wrote"):
        Weights.load(path)
    with pytest.raises(FileNotFoundError):
        Weights.load(tmp_path / "none.npz")


def test_weights_that_do_not_fit_are_refused_by_name():
    arrays = dict(reference.random_weights("joint").arrays)
    with pytest.raises(WeightsError, match="network must be one of firenet, joint"):
        Weights("e2vid", arrays)
    with pytest.raises(WeightsError, match="have no 'more'"):
        Weights("joint", {**arrays, "more": arrays["pred.bias"]})
    with pytest.raises(WeightsError, match=r"head.weight must be float32 of"):
        Weights("firenet", arrays)
    with pytest.raises(WeightsError, match=r"g1\.new\.bias must be finite"):
        Weights("joint", {**arrays, "g1.new.bias": np.full(16, np.nan, np.float32)})
    arrays.pop("r2.b.bias")
    with pytest.raises(WeightsError, match=r"need 'r2\.b\.bias'"):
        Weights("joint", arrays)
