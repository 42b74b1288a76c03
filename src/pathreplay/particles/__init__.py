"""Light paths: particles that start at emitters and are connected to the sensor."""
