"""What scenes and reports know of each thermostat, a `Thermostat` of `scene.ensemble_methods`.

Its flow is in `dynamics.thermostats`, in the file of the same name.
"""
