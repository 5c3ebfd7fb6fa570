"""Results of a search without contact: the areas where the emitter would have been heard."""
