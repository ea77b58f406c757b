"""What is read off a state: observables and drift. Never writes to it."""
