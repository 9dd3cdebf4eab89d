"""Adapters with which other libraries open recordings.

``patching`` replaces ``cv2.VideoCapture`` in programs that call it; ``pims_reader``,
``imageio_plugin`` and ``napari_plugin`` are plugins of pims, imageio and napari, which
must be installed.
"""
