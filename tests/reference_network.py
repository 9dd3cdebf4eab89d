"""The recurrent networks in plain NumPy, and weights to try them with."""
import numpy as np

from pdavis_cv.reconstruct.weights import Weights, expected_shapes

PLACE_OF = {(1, 0): 0, (1, 1): 1, (0, 1): 2, (0, 0): 3}


def random_weights(network, seed=0, *, unit=0.2):
    random = np.random.default_rng(seed)
    arrays = {}
    for name, shape in expected_shapes(network).items():
        scale = 0.1 if name.endswith("bias") else np.sqrt(2 / np.prod(shape[1:]))
        arrays[name] = (scale * random.normal(size=shape)).astype(np.float32)
    return Weights(network, arrays, unit)


def voxel_planes(events, start, stop, on, off, shape, bins=5):
    """Every event against every bin, in float64; (place, bin, y, x)."""
    h, w = (shape[0] + 1) // 2, (shape[1] + 1) // 2
    out = np.zeros((4, bins, h, w))
    on, off = np.broadcast_to(on, shape), np.broadcast_to(off, shape)
    for t, x, y, p in events.tolist():
        at = (bins - 1) * (t - start) / (stop - start)
        step = on[y, x] if p else -off[y, x]
        for k in range(bins):
            out[PLACE_OF[y % 2, x % 2], k, y // 2, x // 2] += step * max(
                0, 1 - abs(at - k))
    return out


def convolve(x, weights, name):
    """Zero-padded correlation of (N, C, H, W), in float64."""
    weight = weights.arrays[f"{name}.weight"].astype(float)
    side = weight.shape[-1]
    edge = side // 2
    padded = np.pad(x, ((0, 0), (0, 0), (edge, edge), (edge, edge)))
    h, w = x.shape[2:]
    total = 0
    for i in range(side):
        for j in range(side):
            total = total + np.einsum(
                "oc,nchw->nohw", weight[:, :, i, j], padded[:, :, i:i + h, j:j + w])
    return total + weights.arrays[f"{name}.bias"][:, None, None]


def network_step(weights, x, h1, h2):
    """One step as FireNet's paper has it: z lets the new value in."""
    def sigmoid(v):
        return 1 / (1 + np.exp(-v))

    def recurrent(i, x, h):
        z, r = np.split(
            sigmoid(convolve(np.concatenate((x, h), 1), weights, f"g{i}.gates")), 2, 1)
        new = np.tanh(convolve(np.concatenate((x, r * h), 1), weights, f"g{i}.new"))
        return (1 - z) * h + z * new

    def residual(i, x):
        inner = np.maximum(convolve(x, weights, f"r{i}.a"), 0)
        return np.maximum(x + convolve(inner, weights, f"r{i}.b"), 0)

    y = np.maximum(convolve(x, weights, "head"), 0)
    h1 = recurrent(1, y, h1)
    h2 = recurrent(2, residual(1, h1), h2)
    y = residual(2, h2)
    direct = weights.arrays["pred.weight"].shape[1] - y.shape[1]
    if direct:
        y = np.concatenate((y, x[:, -direct:]), 1)
    return convolve(y, weights, "pred"), h1, h2


def joint_light(planes):
    """Intensity by place from ln S0 of the four places and S1/S0, S2/S0."""
    s0, (s1, s2) = np.exp(planes[:4]), planes[4:]
    long = np.maximum(np.hypot(s1, s2), 1)
    s1, s2 = s1 / long, s2 / long
    return s0 / 2 * np.stack((1 + s1, 1 + s2, 1 - s1, 1 - s2))


def reconstruct(weights, events, shape, window_us, thetas, windows, memory=(8, 64)):
    """Light by place after each window from the first event's on."""
    first = int(events["t"][0]) // window_us
    h, w = (shape[0] + 1) // 2, (shape[1] + 1) // 2
    n = 4 if weights.network == "firenet" else 1
    h1 = h2 = np.zeros((n, 16, h, w))
    kept = np.zeros((4, 2, h, w))
    for k in range(first, first + windows):
        inside = events[(events["t"] >= k * window_us)
                        & (events["t"] < (k + 1) * window_us)]
        on, off = (1, 1) if weights.unit is None else thetas
        grid = voxel_planes(
            inside, k * window_us, (k + 1) * window_us, on, off, shape)
        kept = kept * np.exp(-1 / np.array(memory))[:, None, None] + (
            grid.sum(1)[:, None])
        x = grid / (weights.unit or 1)
        if n == 1:
            x = np.concatenate((x.reshape(-1, h, w), kept.reshape(-1, h, w)))[None]
        y, h1, h2 = network_step(weights, x, h1, h2)
        yield y[:, 0] if n == 4 else joint_light(y[0])
