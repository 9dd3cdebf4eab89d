"""A browser's view of images, and a stream of pictures for any program.

`serve` answers on an address of this machine: one page that asks for nothing from
elsewhere, and ``/stream.mjpg`` for ``cv2.VideoCapture`` and other players.
"""
from pdavis_cv.viewer.server import Server, serve, view

__all__ = ["Server", "serve", "view"]
