"""What a search team is handed: an emitter's place as GeoJSON, KML, MGRS text and CoT."""
