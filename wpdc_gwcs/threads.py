"""Restriction of the linear algebra library to one thread."""

from threadpoolctl import threadpool_limits

__all__ = ["one_blas_thread"]

#: Decorator: while the function runs, linear algebra uses one thread.  The matrices are small and
#: many: threads gain little on an idle machine, and on a busy one they wait for each other several
#: (up to a thousand) times as long as the work takes.
one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")
