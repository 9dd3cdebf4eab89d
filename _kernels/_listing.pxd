"""Flags of a pixel that a reader of states keeps.  Inline only."""

cdef enum:
    # The pixel is in the list of those that may be moving, and has a lane.  The others
    # are at rest and are held in planes.
    LISTED = 1
    # The lane, or the planes, of the pixel may be out of date.
    CHANGED = 2
    # The pixel is listed but has come to rest since: its planes are filled as well.
    RESTS = 4
    # The pixel has no sample, and the reader leaves such pixels out: it is not listed.
    LEFT_OUT = 8
