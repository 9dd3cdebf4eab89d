"""Flags of a pixel that a reader of states keeps.  Inline only."""

cdef enum:
    # It is in the list of those that may move: it has a lane.  Others have a place in
    # the planes of what pixels at rest show.
    LISTED = 1
    # What the lane, or the planes, say of it may not hold any more.
    CHANGED = 2
    # It is listed, but has come to rest since: it has a place in the planes as well.
    RESTS = 4
