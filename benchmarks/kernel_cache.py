"""To be imported before anything of rtkmesh: numba chooses the folder of its compiled kernels when it is imported."""

from rtkmesh_services.runtime.kernel_cache import use_kernel_cache

use_kernel_cache()
