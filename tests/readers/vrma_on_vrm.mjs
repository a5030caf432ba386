// Plays a VRMA on a VRM with three-vrm-animation and says where bones are, per frame.
// Run it in a folder whose node_modules has three, @pixiv/three-vrm and @pixiv/three-vrm-animation:
//   node vrma_on_vrm.mjs AVATAR.vrm MOTION.vrma TIMES.json OUT.json
import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";

const [avatar, motion, times, out] = process.argv.slice(2);
const load = (file) => import(pathToFileURL(path.resolve("node_modules", file)).href);
globalThis.self = globalThis;
const THREE = await load("three/build/three.module.js");
const { GLTFLoader } = await load("three/examples/jsm/loaders/GLTFLoader.js");
const { VRMLoaderPlugin } = await load(
  "@pixiv/three-vrm/lib/three-vrm.module.js",
);
const { VRMAnimationLoaderPlugin, createVRMAnimationClip } = await load(
  "@pixiv/three-vrm-animation/lib/three-vrm-animation.module.js",
);

const loader = new GLTFLoader();
loader.register((parser) => new VRMLoaderPlugin(parser));
loader.register((parser) => new VRMAnimationLoaderPlugin(parser));
const read = (file) => {
  const bytes = fs.readFileSync(file);
  return loader.parseAsync(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length), "");
};
const vrm = (await read(avatar)).userData.vrm;
const animation = (await read(motion)).userData.vrmAnimations[0];
const clip = createVRMAnimationClip(animation, vrm);
const mixer = new THREE.AnimationMixer(vrm.scene);
const action = mixer.clipAction(clip).setLoop(THREE.LoopOnce);
action.clampWhenFinished = true;
action.play();
const frames = JSON.parse(fs.readFileSync(times)).map((time) => {
  mixer.setTime(time);
  vrm.update(0);
  vrm.scene.updateMatrixWorld(true);
  const bones = {};
  for (const name of Object.keys(vrm.humanoid.humanBones)) {
    const node = vrm.humanoid.getRawBoneNode(name);
    const place = new THREE.Vector3();
    const turn = new THREE.Quaternion();
    node.matrixWorld.decompose(place, turn, new THREE.Vector3());
    bones[name] = [...place.toArray(), ...turn.toArray()];
  }
  return bones;
});
fs.writeFileSync(out, JSON.stringify(frames));
console.log(JSON.stringify({ three: THREE.REVISION, duration: clip.duration, tracks: clip.tracks.length }));
