"""Compilation by numba of a function with all that it calls as one piece.

numba makes machine code of each function that compiled code calls, with all that it calls in turn linked in:
the innermost code is optimised once for each of its callers' callers. Here an inner function is only
translated to LLVM's form; the outermost one links all of them, and LLVM optimises that once.

Imported only where numba is installed.
"""

# numba is not typed, and its functions have no types of their own.
# pyright: basic, reportMissingTypeStubs=false, reportIncompatibleMethodOverride=false

from typing import Any

from numba import _dynfunc  # pyright: ignore[reportAttributeAccessIssue]
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering

from khep_twin.compilable import ONCE


class _InnerLibrary(JITCodeLibrary):
    """Code of one inner function, without machine code."""

    def finalize(self) -> None:
        self._raise_if_finalized()
        self._finalized = True

    def _get_module_for_linking(self) -> Any:
        # A function that numba compiles in its own way links what it calls, but nothing further.
        if self._shared_module is None:
            self._shared_module = module = self._final_module.clone()
            _link_all_called(self, module)
            for function in module.functions:
                if not function.is_declaration:
                    function.linkage = "linkonce_odr"
        return self._shared_module

    def get_pointer_to_function(self, name: str) -> int:
        return 0  # only compiled code calls it


class _OuterLibrary(JITCodeLibrary):
    """Code of a function with that of all that it calls."""

    def finalize(self) -> None:
        self._own = {function.name for function in self.get_defined_functions()}
        _link_all_called(self, self._final_module)
        self._linking_libraries = []
        super().finalize()

    def _optimize_final_module(self) -> None:
        for function in self.get_defined_functions():
            if function.name not in self._own:
                function.linkage = "internal"  # LLVM may drop it, and arguments that it does not use
        super()._optimize_final_module()


def _link_all_called(library: Any, module: Any) -> None:
    """Link the code of all that a library needs into a module, and note what they need when loaded."""
    for each in _all_called(library, {}):
        library._reload_init.update(each._reload_init)
        inner = isinstance(each, _InnerLibrary)
        module.link_in(each._final_module if inner else each._get_module_for_linking(), preserve=True)


def _all_called(library: Any, found: dict[Any, None]) -> dict[Any, None]:
    """Return all libraries that a library needs, added to those found."""
    for each in library._linking_libraries:
        if each not in found:
            found[each] = None
            _all_called(each, found)
    return found


@register_pass(mutates_CFG=True, analysis_only=False)
class _InnerLowering(NativeLowering):
    _name = "khep_twin_inner_lowering"

    def run_pass(self, state: Any) -> bool:
        state.library = library = _InnerLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        # Set here, not as options: numba compiles a function again for callers of other options.
        flags = state.flags
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        flags.forceinline = state.func_id.func not in ONCE
        super().run_pass(state)
        made = state["cr"]
        # What numba looks functions up by; it cannot be called.
        name = made.fndesc.qualname.rpartition(".")[2]
        key = _dynfunc.make_function(made.fndesc.lookup_module(), name, "", 0, made.env, (library,))
        state.targetctx.insert_user_function(key, made.fndesc, [library])
        state["cr"] = made._replace(cfunc=key)
        return True


@register_pass(mutates_CFG=True, analysis_only=False)
class _OuterLowering(NativeLowering):
    _name = "khep_twin_outer_lowering"

    def run_pass(self, state: Any) -> bool:
        state.library = _OuterLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        state.flags.no_cfunc_wrapper = True
        return super().run_pass(state)


class InnerCompiler(CompilerBase):
    """Compiler of functions that only compiled code calls."""

    lowering: Any = _InnerLowering

    def define_pipelines(self) -> list[Any]:
        """Return numba's own passes, but for the last step."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        lowering = self.lowering
        passes.passes = [(lowering if each is NativeLowering else each, why) for each, why in passes.passes]
        passes._finalized = False
        passes.finalize()
        return [passes]


class OuterCompiler(InnerCompiler):
    """Compiler of functions that Python calls."""

    lowering = _OuterLowering


INNER: Any = {"pipeline_class": InnerCompiler}
"""Options of functions that only compiled code calls."""
