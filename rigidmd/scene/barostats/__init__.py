"""What scenes and reports know of each barostat, a `Barostat` of `scene.ensemble_methods`.

Its flow is in `dynamics.barostats`, in the file of the same name.
"""
