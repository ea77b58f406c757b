"""Numba's front end without the work that kernels do not need: passes without effect, and the
resolution of calls that it has resolved. Together they take a fifth of the time of a first run."""

from weakref import WeakKeyDictionary

from numba.core import typed_passes, untyped_passes
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager
from numba.core.types.functions import BaseFunction

#: Passes for what no kernel contains: `with`, closures, functions that Numba itself inlines,
#: `literally`, exceptions with arguments; and those that only check or describe.
UNUSED_PASSES = (
    untyped_passes.WithLifting,
    untyped_passes.InlineClosureLikes,
    untyped_passes.RewriteDynamicRaises,
    untyped_passes.InlineInlinables,
    untyped_passes.FindLiterallyCalls,
    untyped_passes.LiteralPropagationSubPipelinePass,
    typed_passes.InlineOverloads,
    typed_passes.NoPythonSupportedFeatureValidation,
    typed_passes.AnnotateTypes,
    typed_passes.DumpParforDiagnostics,
)


def pipeline_of_kernels(compiler: CompilerBase) -> PassManager:
    """The passes of Numba for compiled code, without `UNUSED_PASSES`."""
    complete = DefaultPassBuilder.define_nopython_pipeline(compiler.state)
    passes = PassManager("kernels")
    passes.passes = [one for one in complete.passes if one[0] not in UNUSED_PASSES]
    passes.finalize()
    return passes


def remember_resolved_calls():
    """Let Numba resolve the call of a function once for each list of types of its arguments.

    Type inference asks again for the same call in every iteration and every function: for
    `rigidmd energy systems/argon.toml` 7,100 times, for 543 different calls. Calls that fail are
    not remembered.
    """
    resolve = BaseFunction.get_call_type
    signatures: WeakKeyDictionary[BaseFunction, dict] = WeakKeyDictionary()

    def get_call_type(function, context, args, kws):
        resolved = signatures.setdefault(function, {})
        key = context, args, tuple(kws.items())
        if key not in resolved:
            resolved[key] = resolve(function, context, args, kws)
        return resolved[key]

    BaseFunction.get_call_type = get_call_type
