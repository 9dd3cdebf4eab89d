"""Viewer for browsers, and a stream of pictures for any program.

`serve` runs an HTTP server on this machine: a page that loads nothing from other hosts,
and ``/stream.mjpg`` for ``cv2.VideoCapture`` and other players.
"""
from pdavis_cv.viewer.server import Server, serve, view

__all__ = ["Server", "serve", "view"]
