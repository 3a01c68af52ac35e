// A page with one episode, which is embedded.
"use strict";
load(JSON.parse(element("data").textContent));
