"""Compiled parts of kernels, for tests that call them one by one."""

from dptse_env.utils.kernels import kernel


def compiled(part):
    """Return a kernel that does nothing but call a part; its machine code is kept as any other."""
    # The part is a global name and not one of a closure, which the fingerprint does not look into.
    names = {"part": part, "__name__": part.__module__}
    exec("def call(*args): return part(*args)", names)
    call = names["call"]
    call.__qualname__ = f"call_{part.__name__}"
    return kernel(call)
