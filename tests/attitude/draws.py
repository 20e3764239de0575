"""Tests of thousands of draws: the same kernels run uncompiled in all others."""

import os

import pytest

compiled_only = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="thousands of fits take long without JIT")
