"""Triton's kernels compiled for Hopper, without a GPU: what the assembler says of them."""

import re
import subprocess
from dataclasses import dataclass, field

import torch

POINTERS = {
    torch.float32: "*fp32",
    torch.float16: "*fp16",
    torch.bfloat16: "*bf16",
    torch.int64: "*i64",
    torch.int32: "*i32",
    torch.uint8: "*u8",
    torch.bool: "*i1",
}
ALIGNED = [["tt.divisibility", 16]]


def find_ptxas():
    """Return the path of the assembler that Triton's wheel has for Hopper, or None."""
    try:
        from triton.backends.nvidia.compiler import get_ptxas

        return get_ptxas(90).path
    except (ImportError, RuntimeError, TypeError):
        return None


def signature_of(kernel, values):
    """Return what a launch with these values compiles: signature, constants and alignments."""
    signature, constants, attributes = {}, {}, {}
    for position, parameter in enumerate(kernel.params):
        value = values[parameter.name]
        if parameter.is_constexpr or (type(value) is int and value == 1):  # as a launch does
            signature[parameter.name], constants[parameter.name] = "constexpr", value
        elif isinstance(value, torch.Tensor):
            signature[parameter.name] = POINTERS[value.dtype]
            attributes[(position,)] = ALIGNED
        else:
            signature[parameter.name] = "fp32" if isinstance(value, float) else "i32"
            if isinstance(value, int) and value % 16 == 0:
                attributes[(position,)] = ALIGNED
    return signature, constants, attributes


def resources(kernel, values, options):
    """Compile a kernel for sm_90 as a launch would; return its registers and spilled bytes."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    signature, constants, attributes = signature_of(kernel, values)
    source = ASTSource(fn=kernel, signature=signature, constexprs=constants, attrs=attributes)
    options = {"enable_fp_fusion": True, **options}
    built = triton.compile(source, target=GPUTarget("cuda", 90, 32), options=options)
    command = [find_ptxas(), "-v", "--gpu-name=sm_90a", "-o", "/dev/null", "/dev/stdin"]
    result = subprocess.run(
        command, input=built.asm["ptx"], capture_output=True, text=True, check=True
    )
    said = result.stdout + result.stderr
    spills = re.search(r"(\d+) bytes spill stores, (\d+) bytes spill loads", said)
    return int(re.search(r"Used (\d+) registers", said)[1]), sum(map(int, spills.groups()))


@dataclass
class Recorder:
    """Stands in for a kernel: a launch compiles it and runs nothing."""

    kernel: object
    name: str
    found: list = field(default_factory=list)

    def __getitem__(self, grid):
        return self.launch

    def launch(self, *arguments, **keywords):
        names = [parameter.name for parameter in self.kernel.params]
        values = dict(zip(names, arguments, strict=False))
        values |= {name: keywords.pop(name) for name in names if name in keywords}
        self.found.append((self.name, *resources(self.kernel, values, keywords)))


def launches(module, monkeypatch):
    """Let launches of a module's kernels compile them; return their names, registers, spills."""
    found = []
    for name, kernel in vars(module).items():
        if name.endswith("_kernel"):
            monkeypatch.setattr(module, name, Recorder(kernel, name, found))
    return found
