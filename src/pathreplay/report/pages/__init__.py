"""Pages for the browser: their content as plain data, and the HTML document made from it."""
