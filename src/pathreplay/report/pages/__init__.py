"""The pages that people look at: what one says, as plain data, and the document that a browser shows."""
