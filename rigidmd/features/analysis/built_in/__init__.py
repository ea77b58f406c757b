"""The built-in analyses: each function with `built_in` in a module of this folder is one."""
