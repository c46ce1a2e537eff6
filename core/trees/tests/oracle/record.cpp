// Answers requests of record.py as BehaviorTree.CPP 4.10.0 does: one JSON object a line, in and out.
//
// Compile it with the library's sources, `src/*.cpp` and its folders `actions`, `controls` and
// `decorators`, and with `3rdparty/tinyxml2`:
//     g++ -std=c++17 -Iinclude -I3rdparty -I3rdparty/tinyxml2 -I3rdparty/minicoro ... record.cpp
#include "behaviortree_cpp/bt_factory.h"
#include "behaviortree_cpp/contrib/json.hpp"
#include <cstdio>
#include <iostream>
#include <unistd.h>

using namespace BT;
using json = nlohmann::json;

json leaves, calls;
std::map<std::string, size_t> positions;

NodeStatus step(TreeNode& node, const std::string& name, const char* what)
{
  const json& leaf = leaves[name];
  std::string script;
  for(const auto& letter : leaf["script"])
    script += letter.get<std::string>();
  const size_t i = positions[node.fullPath()]++;
  const char c = script[leaf.value("loop", false) ? i % script.size() : std::min(i, script.size() - 1)];
  calls.push_back(node.fullPath() + ":" + what + ":" + c);
  switch(c)
  {
    case 'S': return NodeStatus::SUCCESS;
    case 'F': return NodeStatus::FAILURE;
    case 'R': return NodeStatus::RUNNING;
    case 'K': return NodeStatus::SKIPPED;
  }
  throw RuntimeError("the leaf's own");
}

struct Action : StatefulActionNode
{
  std::string type;
  Action(const std::string& name, const NodeConfig& config, std::string type)
    : StatefulActionNode(name, config), type(type) {}
  static PortsList providedPorts() { return {}; }
  NodeStatus onStart() override { return step(*this, type, "start"); }
  NodeStatus onRunning() override { return step(*this, type, "run"); }
  void onHalted() override { calls.push_back(fullPath() + ":halt"); }
};

void answer(json& request)
{
  leaves = request["leaves"];
  for(auto& [name, leaf] : leaves.items())
    if(leaf["script"].is_string())
    {
      json letters = json::array();
      for(char c : leaf["script"].get<std::string>())
        letters.push_back(std::string(1, c));
      leaf["script"] = letters;
    }
  positions.clear();
  json& answers = request["answers"] = json::array();
  BehaviorTreeFactory factory;
  for(auto& [name, leaf] : leaves.items())
  {
    const std::string type = name;
    auto tick = [type](TreeNode& node) { return step(node, type, "tick"); };
    if(leaf["kind"] == "action")
      factory.registerNodeType<Action>(name, type);
    else if(leaf["kind"] == "sync")
      factory.registerSimpleAction(name, tick);
    else
      factory.registerSimpleCondition(name, tick);
  }
  Tree tree;
  try
  {
    factory.registerBehaviorTreeFromText(request["xml"].get<std::string>());
    tree = factory.createTree("M");
  }
  catch(std::exception& error)
  {
    request["error"] = "load";
    request["text"] = error.what();
    return;
  }
  auto board = tree.rootBlackboard();
  const json before = request.value("set_before", json::object());
  const json halts = request.value("halt_at", json::array());
  for(int i = 0; i < request["ticks"].get<int>(); i++)
  {
    calls = json::array();
    try
    {
      for(const auto& set : before.value(std::to_string(i), json::array()))
      {
        if(set[1] == "bool")
          board->set(set[0], set[2].get<bool>());
        else if(set[1] == "int")
          board->set(set[0], set[2].get<int>());
        else
          board->set(set[0], set[2].get<std::string>());
      }
      if(std::find(halts.begin(), halts.end(), i) != halts.end())
      {
        tree.haltTree();
        answers.push_back({ "H", calls, json::object() });
        continue;
      }
      const bool once = request.value("mode", "") == "once";
      const auto status = once ? tree.tickOnce() : tree.tickExactlyOnce();
      json watched = json::object();
      for(const auto& watch : request.value("watch", json::array()))
      {
        auto value = board->getAnyLocked(watch[0]);
        const bool set = value && !value.get()->empty();
        watched[watch[0].get<std::string>()] = set ? json(value.get()->cast<int>()) : json();
      }
      const std::string letter = status == NodeStatus::SKIPPED ? "K" : toStr(status).substr(0, 1);
      answers.push_back({ letter, calls, watched });
    }
    catch(std::exception& error)
    {
      request["error"] = "tick";
      request["text"] = error.what();
      return;
    }
  }
}

int main()
{
  // The library prints warnings on standard output.
  FILE* out = fdopen(dup(1), "w");
  dup2(2, 1);
  for(std::string line; std::getline(std::cin, line);)
  {
    json request = json::parse(line);
    answer(request);
    fprintf(out, "%s\n", request.dump().c_str());
  }
  fclose(out);
}
