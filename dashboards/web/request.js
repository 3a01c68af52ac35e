// Requests to the page's own server.
"use strict";

// The JSON that the server answers; with values it is asked to change something.
async function request(path, values = null) {
  const post = {method: "POST", headers: {"Content-Type": "application/json"}, body: JSON.stringify(values)};
  const answer = await fetch(path, values ? post : {cache: "no-cache"}), content = await answer.json();
  if (!answer.ok) throw new Error(content.error);
  return content;
}

// Why a request failed.
function reason(error) {
  return error instanceof TypeError ? "The server does not answer." : error.message;
}
