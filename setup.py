"""The compiled kernels; everything else about the package stands in pyproject.toml."""

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

# No fused operations (the results have the same bits as those of NumPy), and no regard for errno
# and floating-point exceptions, which would keep loops from becoming vector code.
_UNIX_FLAGS = ["-std=gnu11", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"]
_MSVC_FLAGS = ["/std:c11", "/O2", "/fp:precise"]


_HEADERS = ("angles", "common", "inverse", "levels", "peaks", "plane", "sky", "stars")


class BuildKernels(build_ext):
    """Compile with the flags of the compiler at hand."""

    def build_extensions(self):
        """Compile all extensions."""
        flags = _MSVC_FLAGS if self.compiler.compiler_type == "msvc" else _UNIX_FLAGS
        for extension in self.extensions:
            extension.extra_compile_args = flags
        super().build_extensions()


setup(
    ext_modules=[
        Extension(
            "wpdc_gwcs.kernels._compiled",
            ["wpdc_gwcs/kernels/_compiled.c"],
            depends=[f"wpdc_gwcs/kernels/{name}.h" for name in _HEADERS],
            py_limited_api=True,
            # Without a compiler the package installs all the same and computes in NumPy.
            optional=True,
        )
    ],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
    cmdclass={"build_ext": BuildKernels},
)
