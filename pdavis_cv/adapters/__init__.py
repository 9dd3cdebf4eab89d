"""Recordings in other people's programs.

``patching`` lets programs that call ``cv2.VideoCapture`` open recordings,
``pims_reader`` and ``imageio_plugin`` plug into the packages of these names, which
they need installed.
"""
