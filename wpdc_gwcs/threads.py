"""Threads of the linear algebra library, and how to do without them."""

from threadpoolctl import threadpool_limits

__all__ = ["one_blas_thread"]

#: Decorator: while the function runs, linear algebra keeps to one thread.  Matrices here are small
#: and many; threads gain little on an idle machine, and wait for each other for several times the
#: work itself, up to a thousand times, on a busy one.
one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")
