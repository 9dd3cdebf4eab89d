"""Rows of the table of boundaries.py: scenes and parts of a camera."""
import itertools

import numpy as np

from pdavis_cv import simulation
from pdavis_cv.analysis import Wheel

SIDE = 4
T_US = np.array([0.0, 12_345.0, 2.0**61])[:, None, None]
Y, X = np.mgrid[:SIDE, :SIDE].astype(np.float64)


def function(t_us, x, y):
    """Return light that rises over time, for `FunctionScene`."""
    return 1 + np.abs(t_us), 0 * x, 0 * y


def kinds():
    """Return (name, class, good keyword arguments, what uses an object)."""
    s, turn = simulation, {"rpm": 60.0, "s0": 30.0, "start_angle": 0.1}
    flat = s.FlatLight()
    scenes = [
        (s.FlatLight, {"s0": 30.0, "dolp": 0.5, "aop": 0.3}),
        (s.RotatingPolarizer, {**turn, "dolp": 1.0}),
        (s.PolarizerBeforePlate, {**turn, "axis": 0.2, "retardance": 1.5}),
        (s.RotatingPlate, {**turn, "polarizer": 0.2, "retardance": 1.5}),
        (s.MalusSweep, {"step": 0.1, "hold_us": 1e5, "move_us": 1e4, "s0": 30.0,
                        "dolp": 1.0, "start_angle": 0.1}),
        (s.IrradianceSweep, {
            "rpm": 60.0, "low_uw_cm2": 0.04, "high_uw_cm2": 4e4, "levels": 13,
            "hold_us": 1e5, "dn_per_ms": 27.0, "start_angle": 0.1}),
        (s.Sum, {"first": flat, "second": flat}),
        (s.Flicker, {"scene": flat, "hz": 100.0, "depth": 0.2}),
        (s.Fan, {**turn, "bright": 2000.0, "centre": (2.0, 2.0), "radius": 2.5,
                 "hub": 0.5, "edge": 0.5, "opaque": 0.05}),
        (s.Tendon, {
            "hz": 1.0, "strain_low": 0.02, "strain_high": 0.03, "s0": 30.0,
            "retardance": 0.5, "gain": 0.4, "fibre_angle": 0.1, "fibre_width": 9.0,
            "crimp_angle": 0.25, "crimp_length": 60.0, "contrast": 0.4,
            "fixed": (0.0, 2.0)}),
        (s.Texture, {
            "velocity": (200.0, 60.0), "s0": 30.0, "contrast": 0.5, "dolp": 0.5,
            "dolp_spread": 0.4, "aop": 0.8, "aop_spread": 0.6, "longest": 120.0,
            "shortest": 8.0, "waves": 12, "seed": 0}),
        (s.FunctionScene, {
            "function": function, "sampling_us": 100.0, "uniform": False}),
    ]
    parts = [
        ("dvs", s.DvsPixel, {
            "theta_on": 0.15, "theta_off": 0.15, "mismatch": 0.03, "mismatch_ln": 0.01,
            "cutoff_hz": 250.0, "cutoff_hz_per_dn_ms": 8.0, "second_pole_hz": 1000.0,
            "dark_dn_ms": 0.1, "refractory_us": 100.0, "leak_hz": 0.3,
            "leak_sigma": 0.1, "leak_hz_per_dn_ms": 0.01, "shot_noise_hz": 1.0,
            "shot_noise_bright_factor": 0.25, "bright_dn_ms": 51.0,
            "hot_fraction": 0.1, "hot_hz": 100.0, "burst_chance": 0.1,
            "burst_us": 200.0}),
        ("aps", s.ApsPixel, {
            "fps": 100.0, "exposure_us": 5000, "readout_us": 2000,
            "shutter": "global", "adc_bits": 10, "full_well_dn": 760.0,
            "reset_dn": 850.0, "reset_fpn_dn": 24.0, "offset_fpn_dn": 2.0,
            "ktc_dn": 3.0, "read_noise_dn": 1.5, "electrons_per_dn": 80.0,
            "dark_dn_s": 15.0, "black_level_dn": 30.0}),
        ("bus", s.Bus, {"rate_hz": 1e7, "row_us": 0.1}),
        ("faults", s.Faults, {"frame_offset_us": -5000, "jitter_us": 10.0, "lost": 0.1,
                              "drift_on": 0.1, "drift_off": 0.1}),
        ("optics", s.Optics, {
            "extinction_ratio": 40.0, "extinction_ratio_sigma": 3.0,
            "angle_sigma": 0.01, "angle_smooth": 0.01, "gain_sigma": 0.02,
            "gain_smooth": 0.1, "layout": s.Optics().layout}),
    ]
    wheel = {"centre": (2.0, 2.0), "radius": 2.0, "hub": 0.5, "sectors": 6,
             "rpm": 60.0, "start_angle": 0.1, "origin_us": 10, "margin": 0.1}
    return [
        *((kind.__name__, kind, good, seen) for kind, good in scenes),
        *((kind.__name__, kind, good, filmed(part)) for part, kind, good in parts),
        ("Wheel", Wheel, wheel, lambda it: it.labels(10**6, (SIDE, SIDE))),
    ]


def seen(scene):
    """Ask a scene for all that a camera does."""
    assert scene.step_us > 0
    scene.stokes(T_US, X, Y)
    scene.stokes(0, 1, 1)
    scene.lit(X, Y)
    assert isinstance(bool(scene.uniform), bool)


def filmed(part):
    """Return what records 20 ms of a polarizer by a camera with this part."""
    def run(given):
        camera = simulation.Camera.preset(
            "nominal", size=(SIDE, SIDE), **{part: given})
        camera.record(simulation.RotatingPolarizer(rpm=60.0), 0.02)
    return run


def rows():
    """Return (name, callable, good keyword arguments) as `boundaries.table` does."""
    def used(kind, use):
        return lambda **arguments: use(kind(**arguments))

    def stream(**arguments):
        scene = simulation.RotatingPolarizer(rpm=60.0)
        stream = camera.stream(**{"scene": scene, **arguments})
        list(itertools.islice(stream.pieces(), 3))

    s, camera = simulation, simulation.Camera.preset("nominal", size=(SIDE, SIDE))
    preset = s.PRESETS["realistic"]
    return [
        *((name, used(kind, use), good) for name, kind, good, use in kinds()),
        ("Camera", s.Camera, {
            **preset, "faults": s.Faults(), "seed": 0, "size": (SIDE, SIDE),
            "origin": (0, 0), "sensor": camera.sensor,
            "name": "a camera"}),
        ("Camera.stream", stream, {
            "scene": s.FlatLight(), "seconds": 0.02, "run": 0, "threads": 1,
            "step_us": 100.0}),
        ("named_scene", lambda **k: seen(s.named_scene(**k)), {
            "name": "polarizer", "seconds": 1.0, "rpm": 60.0, "hz": 1.0, "seed": 0,
            "start_angle": 0.0, "light": 30.0, "background": 1.0, "flicker_hz": 50.0,
            "camera": "nominal"}),
    ]
