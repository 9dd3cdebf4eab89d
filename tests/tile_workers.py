"""What becomes of the worker processes of tests; each is an initializer of a pool."""
from pdavis_cv.fusion import stripes


def no_room():
    """Let no file grow."""
    import resource
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))


def cannot_read():
    """Let every image fail."""
    def fail(*_):
        raise RuntimeError("cannot read")
    stripes.samples_of = fail
