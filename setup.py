"""Compile _kernels/*.pyx into the private package pdavis_cv._kernels.

Everything declarative is in pyproject.toml.  PDAVIS_CV_DEBUG=1 builds with
bounds checks on; for sanitizers add CFLAGS/LDFLAGS.  Each flavour has its own
build folder: setuptools compares times, not flags, and would reuse the other's.
Kernels compile in parallel, and only where a source is newer than its kernel.
Cython's own code for memory views is a module of its own that they all share:
compiled into each of them it would take more than half of the time.
"""
import os
import re
import subprocess
import sys
import sysconfig
from pathlib import Path
from threading import Lock

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.modified import newer_group

# An explicit list: a missing source must fail, not vanish from the wheel.
KERNELS = (
    "_aedat2",
    "_aedat4",
    "_aop_events",
    "_build",
    "_bus",
    "_clock",
    "_colours",
    "_davis_usb",
    "_degree",
    "_demosaic",
    "_denoise",
    "_elementwise",
    "_event_text",
    "_event_words",
    "_events",
    "_guided",
    "_increments",
    "_increments_frames",
    "_increments_read",
    "_lamp",
    "_leaky",
    "_learning",
    "_network",
    "_picture",
    "_polarization",
    "_redundancy",
    "_samples",
    "_scenes",
    "_simulate",
    "_turning",
)
SOURCE_TREE_ONLY = ("_floor",)  # what lab/bench compares with: no user needs it
SHARED = (
    "_aedat4.h",
    "_check.pxd",
    "_channels.h",
    "_clones.h",
    "_colours.h",
    "_curves.h",
    "_degree.h",
    "_double.pxd",
    "_guided.h",
    "_increments.h",
    "_increments.pxd",
    "_increments_frames.pxd",
    "_lamp.h",
    "_lamp.pxd",
    "_line.h",
    "_lz4.h",
    "_math.h",
    "_math.pxd",
    "_model.pxd",
    "_nodes.h",
    "_picture.h",
    "_pixel.pxd",
    "_prefetch.h",
    "_redundancy.h",
    "_rows.pxd",
    "_samples.h",
    "_scenes.h",
    "_stencil.h",
    "_turning.h",
    "_types.pxd",
    "_weighted.pxd",
)
UTILITY = "pdavis_cv._kernels._cyutility"  # Cython's shared code
DEBUG = os.environ.get("PDAVIS_CV_DEBUG", "0") != "0"
ABI3 = not sysconfig.get_config_var("Py_GIL_DISABLED")  # no abi3 when free-threaded

DIRECTIVES = {
    "language_level": 3,
    "boundscheck": DEBUG,
    "initializedcheck": DEBUG,
    "wraparound": False,
    "cdivision": not DEBUG,
    "freethreading_compatible": True,
}
if sys.platform == "win32":
    CFLAGS = ["/Od", "/Zi"] if DEBUG else ["/O2"]
else:
    # -ffp-contract=off: the same bits with and without FMA.  The other two let
    # sqrtf and selects vectorise; neither changes a value.
    CFLAGS = [*(["-O0", "-g"] if DEBUG else ["-O3", "-g0"]), "-ffp-contract=off",
              "-fno-math-errno", "-fno-trapping-math"]


def shared_by(source):
    """Files of SHARED that a source is compiled with: what is cimported or included."""
    text = Path("_kernels", source).read_text()
    found = {f"{stem}.pxd" for stem in re.findall(r"_kernels\.(\w+) cimport", text)}
    found.update(re.findall(r'"(_\w+\.h)"', text))
    missing = found.difference(SHARED)
    if missing:
        raise SystemExit(f"setup.py: SHARED lacks {', '.join(sorted(missing))}")
    return found.union(*(shared_by(other) for other in found))


def kernel(name):
    return extension(
        f"pdavis_cv._kernels.{name}",
        sources=[f"_kernels/{name}.pyx"],
        depends=[f"_kernels/{file}" for file in sorted(shared_by(f"{name}.pyx"))])


def extension(name, **options):
    return Extension(
        name,
        include_dirs=["_kernels"],
        extra_compile_args=CFLAGS,
        define_macros=[("PDAVIS_CV_DEBUG", str(int(DEBUG))),
                       *([("Py_LIMITED_API", "0x030B0000")] if ABI3 else [])],
        py_limited_api=ABI3,
        **options,
    )


class BuildKernels(build_ext):
    """Keeps what is compiled for an editable install, which pip builds elsewhere."""

    translating = Lock()  # Cython is not made for threads; the C compiler has its own

    def finalize_options(self):
        if self.editable_mode:
            version = f"{sysconfig.get_platform()}-{sys.implementation.cache_tag}"
            self.build_lib = f"{BUILD}/lib.{version}"
            self.build_temp = f"{BUILD}/temp.{version}"
        super().finalize_options()
        # Not among OPTIONS: an editable install initialises its commands once more.
        # One more than there are cores: one may wait for its turn to translate.
        self.parallel = self.parallel or CORES + 1
        self.force = self.force or DEBUG

    def run(self):
        # Here, not earlier: the sdist asks for the sources of all kernels.
        if not (self.editable_mode or self.inplace):
            for ext in [*self.extensions]:
                if ext.name.rpartition(".")[2] in SOURCE_TREE_ONLY:
                    self.extensions.remove(ext)
                    Path(self.get_ext_fullpath(ext.name)).unlink(missing_ok=True)
        super().run()

    def build_extension(self, ext):
        built = self.get_ext_fullpath(ext.name)
        if not self.force and not newer_group([*ext.sources, *ext.depends], built):
            return
        # generated C goes to build/, never beside the .pyx
        if ext.name == UTILITY:
            ext.sources = [self.shared_code()]
        else:
            from Cython.Build import cythonize
            with self.translating:
                translated, = cythonize(
                    ext, build_dir=self.build_temp, include_path=["_kernels"],
                    compiler_directives=DIRECTIVES, force=self.force, quiet=True,
                    shared_utility_qualified_name=UTILITY)
            ext.sources = translated.sources
        super().build_extension(ext)

    def shared_code(self):
        source = Path(self.build_temp, f"{UTILITY.rpartition('.')[2]}.c")
        source.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run([sys.executable, "-m", "cython", f"--generate-shared={source}"],
                       check=True)
        return str(source)


BUILD = f"build/{'debug' if DEBUG else 'release'}"
CORES = (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity")
         else os.cpu_count())
OPTIONS = {"build": {"build_base": BUILD}}
if ABI3:
    OPTIONS["bdist_wheel"] = {"py_limited_api": "cp311"}

# Those that take longest first, so that no core waits for a last one.
LONGEST_FIRST = sorted(
    (*KERNELS, *SOURCE_TREE_ONLY),
    key=lambda name: -Path("_kernels", f"{name}.pyx").stat().st_size)

setup(ext_modules=[extension(UTILITY, sources=["setup.py"]),
                   *(kernel(name) for name in LONGEST_FIRST)], options=OPTIONS,
      cmdclass={"build_ext": BuildKernels})
