"""Compiled kernels (private); typed in pdavis_cv/_kernels.pyi.

Each module is imported when one of its kernels is first used: all take 7 ms.
"""
import importlib

_MODULES = {
    "_aedat2": "aedat2_rows aedat2_samples",
    "_aedat4": "aedat4_events aedat4_packets aedat4_table_fields aedat4_vector",
    "_aop_events": "aop_event_stokes",
    "_build": "DEBUG",
    "_bus": "read_out sort_events",
    "_clock": "cells settle",
    "_colours": "colour_bilinears colour_planes colour_ratios grey_mosaic",
    "_davis_usb": "davis_words",
    "_degree": "lasting_degree",
    "_demosaic": "bilinear bilinear_variance bilinear_weighted binned reached",
    "_denoise": "denoise_events denoise_rates",
    "_elementwise": "exp least_squares mismatch reconcile",
    "_event_text": "text_events",
    "_event_words": "event_columns evt2_words evt3_words ros_events stream_events",
    "_events": "count surface voxel",
    "_guided": "guided",
    "_increments": "increments_commit increments_drop increments_push increments_rest "
                   "increments_weigh",
    "_increments_frames": "increments_back increments_close increments_differ "
                          "increments_node increments_pass",
    "_increments_read": "increments_image increments_move increments_rest_planes",
    "_lamp": "lamp_push lamp_wave",
    "_leaky": "cf_frame cf_frame_authors cf_frame_printed check_events check_times "
              "leak_events leak_read leak_shown mean_around",
    "_learning": "learning_around learning_past learning_rows learning_silences",
    "_network": "voxel_planes",
    "_picture": "fade_bgr hue_bgr ramp_bgr tone_bgr",
    "_polarization": "aop dolp mix s0_aop_dolp stokes",
    "_redundancy": "redundancy_read redundancy_sample redundancy_solve "
                   "saturated_events saturated_fill",
    "_samples": "log_frame",
    "_scenes": "analysed fan_stokes plane_waves texture_stokes",
    "_simulate": "pixel_events",
    "_turning": "turning_events turning_images",
}
"""The kernels of each module."""
_HOMES = {name: module for module, names in _MODULES.items() for name in names.split()}

__all__ = sorted(_HOMES)


def __dir__():
    return __all__


def __getattr__(name):
    if name not in _HOMES:
        raise AttributeError(f"pdavis_cv._kernels has no {name!r}")
    module = importlib.import_module(f"{__name__}.{_HOMES[name]}")
    globals()[name] = kernel = getattr(module, name)
    return kernel
