"""Compilation by numba of a function and all its callees as one unit.

By default numba compiles each called function to machine code, with all its callees linked in, so that the
innermost code is optimised once for each of its callers' callers. Here an inner function is only translated
to LLVM's intermediate form; the outermost function links all of them, and LLVM optimises the result once.

Imported only where numba is installed.
"""

# numba is not typed, nor are its functions.
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
        # A function that numba compiles by default links its direct callees only.
        if self._shared_module is None:
            self._shared_module = module = self._final_module.clone()
            _link_all_called(self, module)
            for function in module.functions:
                if not function.is_declaration:
                    function.linkage = "linkonce_odr"
        return self._shared_module

    def get_pointer_to_function(self, name: str) -> int:
        return 0  # called by compiled code only


class _OuterLibrary(JITCodeLibrary):
    """Code of a function and all its callees."""

    def finalize(self) -> None:
        self._defined_names = {function.name for function in self.get_defined_functions()}
        _link_all_called(self, self._final_module)
        self._linking_libraries = []
        super().finalize()

    def _optimize_final_module(self) -> None:
        for function in self.get_defined_functions():
            if function.name not in self._defined_names:
                function.linkage = "internal"  # LLVM may drop it, and arguments that it does not use
        super()._optimize_final_module()


def _link_all_called(library: Any, module: Any) -> None:
    """Link the code of all dependencies of a library into a module, and note their initialisation."""
    for dependency in _all_called(library, {}):
        library._reload_init.update(dependency._reload_init)
        is_inner = isinstance(dependency, _InnerLibrary)
        code = dependency._final_module if is_inner else dependency._get_module_for_linking()
        module.link_in(code, preserve=True)


def _all_called(library: Any, libraries: dict[Any, None]) -> dict[Any, None]:
    """Add all dependencies of a library to `libraries`; return it."""
    for dependency in library._linking_libraries:
        if dependency not in libraries:
            libraries[dependency] = None
            _all_called(dependency, libraries)
    return libraries


@register_pass(mutates_CFG=True, analysis_only=False)
class _InnerLowering(NativeLowering):
    _name = "khep_twin_inner_lowering"

    def run_pass(self, state: Any) -> bool:
        state.library = library = _InnerLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        # Not set as options, as numba compiles a function again for callers with other options.
        flags = state.flags
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        flags.forceinline = state.func_id.func not in ONCE
        super().run_pass(state)
        result = state["cr"]
        # The key by which numba finds a function; it cannot be called.
        name = result.fndesc.qualname.rpartition(".")[2]
        key = _dynfunc.make_function(result.fndesc.lookup_module(), name, "", 0, result.env, (library,))
        state.targetctx.insert_user_function(key, result.fndesc, [library])
        state["cr"] = result._replace(cfunc=key)
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
        """Return numba's passes with another last step."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        lowering = self.lowering
        passes.passes = [(lowering if step is NativeLowering else step, text) for step, text in passes.passes]
        passes._finalized = False
        passes.finalize()
        return [passes]


class OuterCompiler(InnerCompiler):
    """Compiler of functions that Python calls."""

    lowering = _OuterLowering


INNER: Any = {"pipeline_class": InnerCompiler}
"""Options of functions that only compiled code calls."""
