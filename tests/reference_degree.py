"""NumPy twin of LastingDegree, macropixel by macropixel in float64."""
import numpy as np

LEAST_FACTOR, MOST_FACTOR, LEAST_LIGHT, DOUBTFUL = 0.5, 2.0, 0.05, 9.0


def cells(image):
    """By macropixel the values of its four places, row by row."""
    h, w = (side // 2 for side in image.shape[:2])
    image = image[:2 * h, :2 * w]
    return image.reshape(h, 2, w, 2, *image.shape[2:]).swapaxes(1, 2).reshape(
        h, w, 4, *image.shape[2:])


class Reference:
    """As `LastingDegree`; response (H, W, 3)."""

    def __init__(self, response, frames, late_frames, first_error, sure):
        self.a = cells(response)
        self.solution = np.linalg.pinv(self.a)
        h, w = self.a.shape[:2]
        self.null = np.array([[np.linalg.svd(self.a[y, x].T)[2][3] for x in range(w)]
                              for y in range(h)])
        self.memories = frames, late_frames
        self.first, self.sure = first_error**2, sure
        self.mean, self.seen = np.zeros((2, h, w))
        # long and late: errors, number, products
        self.sums = np.zeros((2, 3, h, w))
        self.last = np.zeros((h, w))

    def add_frame(self, log):
        stokes = np.einsum("yxjk,yxk->yxj", self.solution, np.exp(cells(log)))
        degree = np.hypot(stokes[..., 1], stokes[..., 2]) / stokes[..., 0]
        usable = np.isfinite(degree)
        compared = usable & (self.seen > 0)
        error = np.where(compared, degree - self.mean, 0)
        products, self.last = error * self.last, error
        for memory, sums in zip(self.memories, self.sums, strict=True):
            for total, values in zip(sums, (error**2, compared, products), strict=True):
                total *= 1 - 1 / memory
                wide = np.pad(values.astype(float), 1)
                h, w = values.shape
                for dy, dx in np.ndindex(3, 3):
                    total += wide[dy:dy + h, dx:dx + w]
        self.seen = np.minimum(self.seen + usable, self.memories[0])
        self.mean += np.where(usable, degree - self.mean, 0) / np.maximum(self.seen, 1)

    def lasting(self):
        """Return degree, variance, share."""
        (errors, count, products), (late, number, _) = self.sums
        error = (errors + self.first) / (count + 1)
        latest = late / np.maximum(number, 1)
        own = error / np.maximum(self.seen, 1) + np.maximum(products / (count + 1), 0)
        own = np.minimum(own, error)
        with np.errstate(divide="ignore"):
            share = np.maximum(
                1 - self.sure**2 * np.maximum(error, latest) / self.mean**2, 0)
        return self.mean, np.maximum(own, latest - (error - own)), share

    def weigh(self, log, variance, valid):
        """Return the log intensities of an image."""
        light = np.exp(cells(log))
        power = cells(variance) * light**2
        degree, spread, share = self.lasting()
        out = np.array(log, np.float64)
        for y, x in np.ndindex(degree.shape):
            share_here = share[y, x] * cells(valid)[y, x].all()
            if share_here <= 0:
                continue
            a, n, p = self.a[y, x], self.null[y, x], np.diag(power[y, x])
            gain = p @ n / (n @ p @ n)
            stokes = self.solution[y, x] @ (light[y, x] - gain * (n @ light[y, x]))
            length = np.hypot(*stokes[1:])
            own = length / stokes[0]
            unit = np.array([-own, *stokes[1:] / length]) / stokes[0]
            slope = unit @ self.solution[y, x]
            error = slope @ (p - np.outer(gain, n) @ p) @ slope
            total = error + spread[y, x]
            apart = degree[y, x] - own
            weight = share_here * error / total / (
                1 + (apart**2 / total / DOUBTFUL)**2)
            factor = np.clip(1 + weight * apart / own, LEAST_FACTOR, MOST_FACTOR)
            moved = 1 + (factor - 1) * (a[:, 1:] @ stokes[1:]) / light[y, x]
            for k in range(4):
                out[2 * y + k // 2, 2 * x + k % 2] += np.log(max(moved[k], LEAST_LIGHT))
        return out
