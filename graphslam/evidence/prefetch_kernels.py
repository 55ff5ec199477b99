"""Software prefetch in compiled code.

Maps of many particles do not fit in the cache, and the processor cannot predict which bricks a scan changes; the
kernels know it some bricks ahead.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload


def prefetch(array: Any, row: int, column: int) -> None:
    """Prefetch an element of a 2-D array for writing. It need not exist: nothing is read or written.

    Has no effect if numba is disabled.
    """


@intrinsic
def _prefetch(_: Any, array: Any, row: Any, column: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = signature.args[0]
        made = context.make_array(kind)(context, builder, arguments[0])
        place = cgutils.get_item_pointer(context, builder, kind, made, arguments[1:])
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        call = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [byte, number, number, number]), "llvm.prefetch.p0i8"
        )
        write, all_caches, data = number(1), number(3), number(1)
        builder.call(call, [builder.bitcast(place, byte), write, all_caches, data])
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp), generate


@overload(prefetch)
def _compiled(array, row, column):  # type: ignore[no-untyped-def]  # arguments as those of the lambda, as numba requires
    return lambda array, row, column: _prefetch(array, row, column)  # type: ignore[call-arg]
