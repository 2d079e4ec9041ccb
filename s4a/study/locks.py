"""Files and folders that a process holds against others, until it ends in whatever way (5.1)."""

from importlib.util import find_spec

CAN_HOLD = find_spec("fcntl") is not None  # not on Windows, where nobody can tell who holds what


def hold(handle: int) -> bool:
    """Hold an open file or folder; False where this system cannot.

    Raises
    ------
    OSError
        When another process holds it.
    """
    if CAN_HOLD:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return CAN_HOLD
