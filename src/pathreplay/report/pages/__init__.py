"""Pages for the browser: their content as plain data, and the conversion of the content to HTML."""
