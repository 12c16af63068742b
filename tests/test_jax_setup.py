"""What dfsm changes in a process that uses JAX for other things too; every test in fresh ones."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

OPTION = "xla_cpu_small_while_loop_byte_threshold"
# What XLA has read can be seen in the options that it hands to every compilation.
READ = "import dfsm; dfsm.DFSM; from jaxlib import xla_client as x; "
READ += "o = x.CompileOptions(); print(o.executable_build_options.debug_options)"


def python(code: str, **environment: str) -> subprocess.CompletedProcess:
    plain = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "JAX_ENABLE_X64")}
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=plain | environment,
    )


def test_64_bits_begin_with_the_first_name_that_computes(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,x\n0,1\n1,2\n2,3\n")
    code = f"""
import dfsm, jax.numpy as jnp
print(jnp.ones(1).dtype)
dfsm.read({str(path)!r})
print(jnp.ones(1).dtype)
dfsm.DFSM
print(jnp.ones(1).dtype, jnp.ones(1, "float32").dtype)
"""
    done = python(code)
    assert done.stdout.split() == ["float32", "float32", "float64", "float32"]
    assert done.stderr == ""


@pytest.mark.parametrize("value", ["0", "False"])
def test_a_wish_for_32_bits_is_answered(value):
    code = "import dfsm, jax; dfsm.DFSM; print(jax.numpy.ones(1).dtype)"
    done = python(code, JAX_ENABLE_X64=value)
    assert done.stdout.strip() == "float64"
    assert done.stderr.count("DfsmWarning: JAX_ENABLE_X64 asks for 32 bits") == 1


def test_the_environment_is_left_as_it_was():
    code = "import os, dfsm; dfsm.DFSM; print(os.environ.get('XLA_FLAGS'))"
    assert python(code).stdout.strip() == "None"
    own = "--xla_cpu_enable_fast_math=false"
    assert python(code, XLA_FLAGS=own).stdout.strip() == own


def test_xla_reads_the_option_and_the_flags_of_the_user():
    own = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
    seen = python(READ, XLA_FLAGS=own).stdout
    assert f'"{OPTION}"' in seen
    assert "2000000" in seen


@pytest.mark.parametrize(
    "own",
    [
        "--xla_backend_extra_options=xla_cpu_use_fusion_emitters=true",
        f"--xla_backend_extra_options={OPTION}=5",
    ],
)
def test_extra_options_of_the_user_stay(own):
    seen = python(READ, XLA_FLAGS=own).stdout
    assert own.split("=")[1] in seen
    assert "2000000" not in seen
