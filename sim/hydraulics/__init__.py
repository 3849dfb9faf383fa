"""Load-sensing hydraulics: the circuit, its parameters as arrays, and the compiled kernel that advances it."""
