"""What a search that hears nothing has found: where the emitter would have been heard."""
