"""Memory asked for before it is needed."""

from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.np import arrayobj

_intrinsic: Any = extending.intrinsic
_make_array: Any = arrayobj.make_array

_BYTE, _WORD = ir.IntType(8).as_pointer(), ir.IntType(32)
_FETCH = ir.FunctionType(ir.VoidType(), (_BYTE, _WORD, _WORD, _WORD))
_TO_READ_FROM_ALL_CACHES_AS_DATA = [ir.Constant(_WORD, number) for number in (0, 3, 1)]


@_intrinsic
def fetch(_typing: Any, array: Any, index: Any) -> Any:
    """Ask for an element of an array, which is on its way from memory while other work goes on.

    Any index will do: what does not exist is not asked for.

    Source: LLVM Language Reference, `llvm.prefetch`.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = builder.gep(_make_array(signature.args[0])(context, builder, args[0]).data, [args[1]])
        how = [builder.bitcast(place, _BYTE), *_TO_READ_FROM_ALL_CACHES_AS_DATA]
        builder.call(builder.module.declare_intrinsic("llvm.prefetch", (_BYTE,), _FETCH), how)
        return context.get_dummy_value()

    return types.void(array, index), generate
