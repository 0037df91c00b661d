// The flight and the hall inside a shared file -> a player; nothing is fetched.

import { Player } from "./player.js";
import { SplatView } from "./splats.js";

/** The bytes of base64 text inside an element of this page. */
export function bytesInPage(id) {
  return Uint8Array.from(atob(document.getElementById(id).textContent.trim()), (one) => one.charCodeAt(0));
}

/** Text that gzip packed. */
export async function unpackText(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
}

/** Draw the hall around a player's flight; without it the flight is a map. */
export async function fillHall(player, view, scene) {
  try {
    await view.loadBytes(scene.buffer);
    player.say("");
    player.seek(player.t);
  } catch (error) {
    player.say(`The hall cannot be drawn here (${error.message}): the flight is drawn as a map.`);
    player.chooseCamera("map");
  }
}

/** Show the flight of this file. */
export async function openShared() {
  const box = document.getElementById("player");
  try {
    const data = JSON.parse(await unpackText(bytesInPage("flight")));
    const scene = bytesInPage("scene");
    let view = null;
    let why = scene.length ? "This browser has no WebGL2: the flight is drawn as a map." : "";
    const canvas = document.createElement("canvas");
    if (scene.length && SplatView.supported()) {
      try {
        view = new SplatView(canvas, { background: "#1b222b" });
        why = "Unpacking the hall \u2026";
      } catch (error) {
        why = `The hall cannot be drawn here (${error.message}): the flight is drawn as a map.`;
      }
    }
    const player = new Player(box, data, view, view ? canvas : null);
    player.say(why);
    if (view) await fillHall(player, view, scene);
  } catch (error) {
    box.textContent = `This file cannot be shown here (${error.message}); open it in a newer browser.`;
  }
  box.dataset.ready = "true";
}
