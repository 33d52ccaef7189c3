"""Keys of functions: digests of their code and of every value that they reach.

Two functions with equal keys compute the same, also in different processes, so that compiled code
may be shared by key. A key follows closures, default arguments, global names, attributes of modules
and of objects, and the functions among them. Functions of the libraries in `TRUSTED_LIBRARIES` do
not change while a process runs, so the globals that they read are not followed. If the value that a
function uses cannot be found without running the function, the function has no key.
"""

import dataclasses
import dis
import enum
import functools
import hashlib
import operator
import sys
import sysconfig
import types
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

TRUSTED_LIBRARIES = frozenset(
    [
        "beartype",
        "diffrax",
        "equinox",
        "jax",
        "jaxlib",
        "jaxtyping",
        "lineax",
        "llvmlite",
        "ml_dtypes",
        "numpy",
        "optax",
        "optimistix",
        "scipy",
        "vrw_jax",
    ]
)
"""Libraries whose versions, or sources, are part of every key that is written to disk."""

PURE_STANDARD_MODULES = frozenset(
    [
        "abc",
        "builtins",
        "cmath",
        "collections",
        "copy",
        "dataclasses",
        "enum",
        "fractions",
        "functools",
        "itertools",
        "math",
        "numbers",
        "operator",
        "typing",
    ]
)
"""Modules of the standard library whose functions depend on their arguments alone."""

OPAQUE_NAMES = frozenset(
    [
        "__import__",
        "attrgetter",
        "compile",
        "delattr",
        "dir",
        "eval",
        "exec",
        "fromfile",
        "fromregex",
        "genfromtxt",
        "getattr",
        "globals",
        "id",
        "input",
        "load",
        "loadmat",
        "loadtxt",
        "locals",
        "memmap",
        "methodcaller",
        "open",
        "open_memmap",
        "random",
        "setattr",
        "tree_deserialise_leaves",
        "vars",
    ]
)
"""Names of functions that reach values by a computed name, or values outside the program."""

C_FUNCTION_TYPES = (
    types.WrapperDescriptorType,
    types.MethodDescriptorType,
    types.ClassMethodDescriptorType,
    types.GetSetDescriptorType,
    types.MemberDescriptorType,
)
"""Types of attributes that are written in C."""

MAX_REACHED_VALUES = 20_000
"""Largest number of values in a key, chosen because it takes a tenth of a second to digest them."""

DESCRIPTIVE_ATTRIBUTES = frozenset(
    [
        "__annotate__",
        "__annotate_func__",
        "__annotations__",
        "__annotations_cache__",
        "__dataclass_fields__",
        "__dataclass_params__",
        "__dict__",
        "__doc__",
        "__firstlineno__",
        "__match_args__",
        "__module__",
        "__qualname__",
        "__repr__",
        "__static_attributes__",
        "__weakref__",
        "_abc_impl",
    ]
)
"""Attributes of classes, functions and objects on which no result depends."""


transparent_wrapper_codes: set[types.CodeType] = set()
"""Code of wrappers that only check arguments: the key is that of the wrapped function."""


class UnresolvableFunctionError(Exception):
    """Error for a function without a key. Its text names the value that cannot be found."""


def make_key(*values: Any) -> str:
    """Return the key of functions and values, as hexadecimal digits.

    Raise an `UnresolvableFunctionError` if a function reaches a value that cannot be found without
    running it, or a value that JAX traces.
    """
    return make_key_with_origin(*values)[0]


def make_key_with_origin(*values: Any) -> tuple[str, bool]:
    """Return the key of `make_key`, and whether only libraries define the functions in it.

    If only libraries do, the key holds as long as the process runs.
    """
    digester = _Digester()
    for value in values:
        digester.add(value)
    return digester.hasher.hexdigest(), not digester.reaches_user_code


def lift_numbers(function: Callable) -> tuple[list[Any], Callable[[Sequence[Any]], Callable]]:
    """Return the numbers in the closure of a user's function, and how to replace them.

    The numbers are floats and arrays of floats. They are found in closures, and in pytrees,
    partially applied functions and bound methods there. The second result returns the function with
    other values for these numbers, so that they can be arguments of a compiled function.
    """
    numbers: list[Any] = []

    def lift(value: Any, enclosing_ids: frozenset[int]) -> Callable[[Sequence[Any]], Any]:
        """Return a function of all numbers that makes `value` anew."""
        is_array = isinstance(value, np.ndarray | np.generic | jax.Array)
        if isinstance(value, float) or (is_array and np.issubdtype(value.dtype, np.floating)):
            numbers.append(value)
            return operator.itemgetter(len(numbers) - 1)
        if id(value) in enclosing_ids or _is_trusted_function(value):
            return lambda _: value
        lift_inner = functools.partial(lift, enclosing_ids=enclosing_ids | {id(value)})
        if isinstance(value, types.FunctionType) and value.__closure__:
            try:
                cells = [lift_inner(cell.cell_contents) for cell in value.__closure__]
            except ValueError:  # A cell has no value yet.
                return lambda _: value
            return lambda new_numbers: _with_closure(value, [c(new_numbers) for c in cells])
        if isinstance(value, types.MethodType):
            owner = lift_inner(value.__self__)
            return lambda new_numbers: types.MethodType(value.__func__, owner(new_numbers))
        if type(value) is functools.partial:
            parts = [lift_inner(x) for x in (value.func, value.args, value.keywords)]

            def bind(new_numbers: Sequence[Any]) -> Callable:
                function, arguments, keywords = (part(new_numbers) for part in parts)
                return functools.partial(function, *arguments, **keywords)

            return bind
        leaves, structure = jax.tree.flatten(value)
        if len(leaves) == 1 and leaves[0] is value:
            return lambda _: value
        inner = [lift_inner(leaf) for leaf in leaves]
        return lambda new_numbers: jax.tree.unflatten(structure, [x(new_numbers) for x in inner])

    rebuild = lift(function, frozenset())
    return numbers, rebuild


def make_placeholder(number: Any) -> tuple:
    """Return what stands in a key for a number that is an argument of the compiled function."""
    aval = jax.typeof(number)
    return "argument", aval.shape, aval.dtype.name, aval.weak_type


def _with_closure(function: types.FunctionType, cell_values: Sequence[Any]) -> types.FunctionType:
    """Return a function with the code of `function` and other values in its closure."""
    copied_function = types.FunctionType(
        function.__code__,
        function.__globals__,
        function.__name__,
        function.__defaults__,
        tuple(map(types.CellType, cell_values)),
    )
    copied_function.__kwdefaults__ = function.__kwdefaults__
    copied_function.__dict__.update(function.__dict__)
    return copied_function


class _Digester:
    """Digest of values and of everything they reach."""

    def __init__(self) -> None:
        self.hasher = hashlib.sha256()
        self.position_by_id: dict[int, int] = {}
        self.reached_values: list[Any] = []  # keeps each `id` valid
        self.reaches_user_code = False

    def write(self, *parts: Any) -> None:
        """Add strings and numbers whose `repr` is the same in every process."""
        self.hasher.update(repr(parts).encode())

    def add(self, value: Any) -> None:
        """Add a value by its content, or the position of its first occurrence."""
        if type(value) in (type(None), type(Ellipsis), str, bytes, bool, int, complex):
            return self.write(type(value).__name__, value)
        if type(value) is float:
            return self.write("float", value.hex())
        if id(value) in self.position_by_id:
            return self.write("again", self.position_by_id[id(value)])
        if len(self.reached_values) == MAX_REACHED_VALUES:
            raise UnresolvableFunctionError(f"it reaches more than {MAX_REACHED_VALUES} values")
        self.position_by_id[id(value)] = len(self.reached_values)
        self.reached_values.append(value)
        self.add_object(value)

    def add_object(self, value: Any) -> None:
        """Add an object that occurs for the first time."""
        value_type = type(value)
        if isinstance(value, jax.core.Tracer):
            raise UnresolvableFunctionError("it refers to a value that JAX traces")
        if isinstance(value, enum.Enum):
            self.write("enum", value.name)
            self.add(value_type)
        elif isinstance(value, np.ndarray | np.generic | jax.Array):
            self.add_array(value)
        elif isinstance(value, np.dtype):
            self.write("dtype", value.str)
        elif isinstance(value, type):
            self.add_class(value)
        elif isinstance(value, types.FunctionType):
            self.add_function(value)
        elif isinstance(value, types.MethodType):
            self.add_all("method", value.__func__, value.__self__)
        elif isinstance(value, functools.partial):
            self.add_all("partial", value.func, value.args, value.keywords)
        elif isinstance(value, types.ModuleType):
            self.add_module_value(value, ())
        elif isinstance(value, types.BuiltinFunctionType | np.ufunc):
            self.add_builtin(value)
        elif isinstance(value, Mapping):
            self.add_all("mapping", value_type, *value.keys(), *value.values())
        elif isinstance(value, tuple | list):
            self.add_all("sequence", value_type, *value)
        elif isinstance(value, set | frozenset):
            self.write("set", sorted(make_key(x) for x in value))
        elif isinstance(value, jax.tree_util.PyTreeDef):
            node = value.node_data()
            self.add_all("structure", value.num_leaves, node, *value.children())
        elif value_type.__name__ in ("PjitFunction", "_lru_cache_wrapper"):
            self.add_all("wrapper", value.__wrapped__)  # from jax.jit or functools.cache
        elif isinstance(value, C_FUNCTION_TYPES):
            self.add_all("attribute", value.__name__, value.__objclass__)
        elif isinstance(value, weakref.ref):
            self.add_all("reference", value())
        elif value_type is object:
            self.write("sentinel")  # Its later occurrences have its position.
        elif isinstance(value, property | classmethod | staticmethod):
            parts = [getattr(value, x, None) for x in ("fget", "fset", "__func__")]
            self.add_all(value_type.__name__, *parts)
        elif hasattr(value, "__dict__") or hasattr(value, "__slots__"):
            self.add_instance(value)
        else:
            raise UnresolvableFunctionError(f"it refers to {value_type.__qualname__} objects")

    def add_all(self, label: str, *values: Any) -> None:
        self.write(label, len(values))
        for value in values:
            self.add(value)

    def add_array(self, array: Any) -> None:
        numbers = np.asarray(array)
        if numbers.dtype == object:
            raise UnresolvableFunctionError("it refers to an array of objects")
        is_weakly_typed = isinstance(array, jax.Array) and array.weak_type
        self.write("array", type(array).__name__, numbers.shape, numbers.dtype.str, is_weakly_typed)
        self.hasher.update(numbers.tobytes())

    def add_builtin(self, function: Any) -> None:
        owner = getattr(function, "__self__", None)
        name = getattr(function, "__qualname__", function.__name__)
        if name.rpartition(".")[2] in OPAQUE_NAMES:
            raise UnresolvableFunctionError(f"it calls {name}")
        if owner is not None and not isinstance(owner, types.ModuleType | type):
            self.add(owner)
        elif isinstance(owner, types.ModuleType):
            self.require_pure_module(owner.__name__)
        self.write("builtin", getattr(function, "__module__", None), name)

    def add_class(self, value: type) -> None:
        if is_trusted(value.__module__) and _is_found_by_name(value):
            return self.write("class", value.__module__, value.__qualname__)
        self.reaches_user_code = True
        attributes = {
            name: attribute
            for name, attribute in _without_descriptions(vars(value)).items()
            if not isinstance(attribute, types.MemberDescriptorType | types.GetSetDescriptorType)
        }
        self.add_all("class", value.__qualname__, value.__bases__, attributes, type(value))

    def add_instance(self, value: Any) -> None:
        """Add an object by its class and its attributes, which are read at each call."""
        if isinstance(value, str | bytes | int | float | complex):
            self.write("number or text", repr(value.__reduce_ex__(2)[1:2]), str(value))
        slots = {
            name: getattr(value, name)
            for base in type(value).__mro__
            for name in _as_tuple(vars(base).get("__slots__", ()))
            if name not in ("__dict__", "__weakref__") and hasattr(value, name)
        }
        attributes = getattr(value, "__dict__", {})
        self.add_all("object", type(value), slots, _without_descriptions(attributes))

    def add_module_value(self, value: Any, attribute_chain: Sequence[str]) -> None:
        """Add the value that code reads by `value.a.b`, where the first names may be modules."""
        if not isinstance(value, types.ModuleType):
            return self.add(value)
        if is_trusted(value.__name__):
            self.require_pure_module(value.__name__, attribute_chain)
            return self.write("module", value.__name__, tuple(attribute_chain[:1]))
        if not attribute_chain:
            raise UnresolvableFunctionError(f"it uses the module {value.__name__} as a value")
        name, *inner_chain = attribute_chain
        if name not in vars(value):
            raise UnresolvableFunctionError(f"the module {value.__name__} has no {name}")
        return self.add_module_value(vars(value)[name], inner_chain)

    def require_pure_module(self, module_name: str, attribute_chain: Sequence[str] = ()) -> None:
        """Raise an error if a library's function may depend on more than its arguments."""
        library = module_name.split(".")[0].lstrip("_")  # `_operator` is `operator` in C.
        full_name = ".".join([module_name, *attribute_chain])
        names = set(full_name.split("."))
        if library == "jax":
            names.discard("random")  # Its functions have no hidden state.
        is_pure = library in TRUSTED_LIBRARIES or library in PURE_STANDARD_MODULES
        if not is_pure or names & OPAQUE_NAMES:
            raise UnresolvableFunctionError(f"it uses {full_name}")

    def add_function(self, function: types.FunctionType) -> None:
        if function.__code__ in transparent_wrapper_codes:
            return self.add(function.__wrapped__)  # type: ignore[attr-defined]
        if _is_trusted_function(function):
            module_name = function.__globals__["__name__"]
            self.require_pure_module(module_name, function.__qualname__.split("."))
            self.write("function", module_name, _digest_code(function.__code__))
        else:
            self.reaches_user_code = True
            self.add_code(function.__code__, function)
            self.add(_without_descriptions(vars(function)))
        cells = function.__closure__ or ()
        try:
            cell_values = [cell.cell_contents for cell in cells]
        except ValueError:
            raise UnresolvableFunctionError("a variable of its closure has no value yet") from None
        module_names = {
            name
            for name, value in zip(function.__code__.co_freevars, cell_values, strict=True)
            if isinstance(value, types.ModuleType)
        }  # Their attributes are added with the code.
        for name, value in zip(function.__code__.co_freevars, cell_values, strict=True):
            if name not in module_names or _is_trusted_function(function):
                self.add(value)
        self.add_all("defaults", function.__defaults__, function.__kwdefaults__)
        return None

    def add_code(self, code: types.CodeType, function: types.FunctionType) -> None:
        """Add the code of a user's function, and the values of the names in it."""
        facts = _read_code(code)
        if facts.obstacle:
            raise UnresolvableFunctionError(facts.obstacle)
        self.write("code", facts.digest)
        global_values = function.__globals__
        builtin_values = global_values.get("__builtins__", {})
        if isinstance(builtin_values, types.ModuleType):
            builtin_values = vars(builtin_values)
        free_modules = dict(
            zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        )
        for name, attribute_chain in facts.global_reads:
            if name in global_values:
                self.add_module_value(global_values[name], attribute_chain)
            elif name in builtin_values:
                self.add(builtin_values[name])
            else:
                self.write("undefined", name)
        for name, attribute_chain in facts.free_reads:
            value = free_modules[name].cell_contents if name in free_modules else None
            if isinstance(value, types.ModuleType):
                self.add_module_value(value, attribute_chain)
        for module_name in facts.imported_modules:
            if not is_trusted(module_name):
                raise UnresolvableFunctionError(f"it imports {module_name} when it runs")
            self.require_pure_module(module_name)
        for constant in facts.inner_codes:
            self.add_code(constant, function)


@dataclasses.dataclass(frozen=True)
class _CodeFacts:
    """What the code of a user's function reads by name."""

    digest: str
    obstacle: str
    global_reads: tuple[tuple[str, tuple[str, ...]], ...]  # name, and attributes read from it
    free_reads: tuple[tuple[str, tuple[str, ...]], ...]
    imported_modules: tuple[str, ...]
    inner_codes: tuple[types.CodeType, ...]


@functools.cache
def _read_code(code: types.CodeType) -> _CodeFacts:
    reads: dict[str, list] = {"global": [], "free": []}
    imported_modules, obstacle = [], ""
    instructions = [x for x in dis.get_instructions(code) if x.opname not in ("CACHE", "PUSH_NULL")]
    for i, instruction in enumerate(instructions):
        name = instruction.opname
        if name in ("STORE_GLOBAL", "DELETE_GLOBAL"):
            obstacle = f"it sets the global name {instruction.argval}"
        elif name == "IMPORT_NAME":
            imported_modules.append(instruction.argval)
        elif name in ("LOAD_GLOBAL", "LOAD_NAME") or name.startswith(
            ("LOAD_DEREF", "LOAD_CLASSDEREF", "LOAD_FROM_DICT_OR_DEREF")
        ):
            attribute_chain = []
            for following in instructions[i + 1 :]:
                if following.opname not in ("LOAD_ATTR", "LOAD_METHOD"):
                    break
                attribute_chain.append(following.argval)
            kind = "global" if name in ("LOAD_GLOBAL", "LOAD_NAME") else "free"
            reads[kind].append((instruction.argval, tuple(attribute_chain)))
    return _CodeFacts(
        _digest_code(code),
        obstacle,
        tuple(dict.fromkeys(reads["global"])),
        tuple(dict.fromkeys(reads["free"])),
        tuple(imported_modules),
        tuple(x for x in code.co_consts if isinstance(x, types.CodeType)),
    )


@functools.cache
def _digest_code(code: types.CodeType) -> str:
    """Return a digest of bytecode, constants and names, without file names and line numbers."""
    constants = [
        _digest_code(x) if isinstance(x, types.CodeType) else make_key(x) for x in code.co_consts
    ]
    parts = (
        code.co_code,
        constants,
        code.co_names,
        code.co_varnames,
        code.co_freevars,
        code.co_cellvars,
        (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags),
        code.co_exceptiontable,
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()


@functools.cache
def is_trusted(module_name: str | None) -> bool:
    """Return whether a module belongs to a library that does not change while a process runs."""
    library = (module_name or "").split(".")[0]
    if library in TRUSTED_LIBRARIES:
        return True
    if library not in sys.stdlib_module_names:
        return False
    # A user's file may have the name of a module of the standard library.
    source = getattr(sys.modules.get(library), "__file__", None)
    return source is None or source.startswith(
        (sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib"))
    )


def _is_trusted_function(value: Any) -> bool:
    """Return whether a library defines a function; decorators copy `__module__` to others."""
    return isinstance(value, types.FunctionType) and is_trusted(value.__globals__.get("__name__"))


def _is_found_by_name(value: type) -> bool:
    """Return whether a class is what its module calls by its name."""
    found: Any = sys.modules.get(value.__module__)
    for name in value.__qualname__.split("."):
        found = getattr(found, name, None)
    return found is value


def _without_descriptions(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {name: x for name, x in attributes.items() if name not in DESCRIPTIVE_ATTRIBUTES}


def _as_tuple(names: Any) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)
