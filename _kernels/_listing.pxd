"""Flags of a pixel that a reader of states keeps.  Inline only."""

cdef enum:
    # The pixel is in the list of those that may be moving, and has a lane.  The others
    # are at rest and are held in planes.
    LISTED = 1
    # The lane, or the planes, of the pixel may be out of date.
    CHANGED = 2
    # The pixel is listed but has come to rest since: its planes are filled as well.
    RESTS = 4
    # Events do not list the pixel: it is hot, so that they have no weight, or it has no
    # sample, and the reader leaves such pixels out.
    LEFT_OUT = 8
    # With CHANGED: the pixel's state may have changed as well, not only its events, or
    # the pixel has no lane yet.
    NEW_STATE = 16
